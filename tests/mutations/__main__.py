"""Bugs planted one at a time, and which the fast tests notice: python -m tests.mutations --output mutations.json

Each bug of tests/mutations/bugs is planted in a copy of the repository, and the fast tests that run its lines are run
there until one fails. Which tests run which lines is recorded first, by coverage.py (pip install coverage), and kept in
build/. Ends with status 1 where tests fail without any bug, or a bug's old text is no longer where it was.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path

from nerfloom.training.machine import machine
from tests.mutations import campaign
from tests.mutations.bug import Bug, all_bugs, faults_of
from tests.mutations.copy import ROOT, make_copy
from tests.mutations.reach import Reach
from tests.mutations.report import as_plain, summary

KEPT = ROOT / "build" / "mutations-reach.json"


def main() -> int:
    """Returns: the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutations", description=__doc__)
    parser.add_argument("--only", action="append", metavar="NAME", help="of a bug, or of a kind; all if not given")
    parser.add_argument("--list", action="store_true", help="show the bugs, and plant none")
    parser.add_argument("--record", action="store_true", help="record anew what all tests run; plant none if alone")
    parser.add_argument("--jobs", type=int, default=campaign.default_jobs(), help="bugs at a time")
    parser.add_argument("--most", type=int, help="tests for a bug; all that run its lines if not given")
    parser.add_argument("--without", action="append", default=[], metavar="FOLDER", help="as if these tests were not")
    parser.add_argument("--output", type=Path, help="JSON file for what became of each bug")
    flags = parser.parse_args()
    chosen = [bug for bug in all_bugs() if not flags.only or {bug.name, bug.kind} & set(flags.only)]
    if flags.list:
        print("\n".join(f"{bug.kind:12} {bug.name:34} {bug.file}: {bug.means}" for bug in chosen))
    faults = faults_of(chosen, ROOT) if chosen else [f"there is no bug {', '.join(flags.only)}"]
    if faults:
        print("\n".join(faults), file=sys.stderr)
        return 1
    if flags.list:
        return 0
    try:
        return _run(flags, chosen)
    except campaign.TestsFail as error:
        print(error, file=sys.stderr)
        return 1


def _run(flags: argparse.Namespace, chosen: list[Bug]) -> int:
    begun = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="mutations-") as temporary:
        whole = make_copy(Path(temporary) / "whole")
        known = Reach.load(KEPT) if KEPT.exists() and not flags.record else None
        without = tuple(flags.without)
        reach = campaign.updated(known, whole, Path(temporary) / "record", os.cpu_count() or 1, without)
        reach.save(KEPT)
        reach = reach.without(name for name in reach.files if name.startswith(without))
        print(f"{len(reach.seconds):,} tests pass without a bug", flush=True)
        results = []
        for result in campaign.run(chosen, reach, Path(temporary), flags.jobs, flags.most):
            results.append(result)
            found = result.noticed_by or f"NOT NOTICED by {result.tests} tests"
            print(f"{len(results):3}/{len(chosen)} {result.seconds:4.0f} s  {result.bug.name}: {found}", flush=True)
        unfounded = campaign.confirm(results, reach, whole)
    print(summary(results))
    if flags.output is not None:
        seconds = round(time.monotonic() - begun, 1)
        flags.output.write_text(json.dumps(as_plain(results, seconds, machine()), indent=2) + "\n")
    if unfounded is not None:
        print(f"fails without any bug, too: {unfounded}", file=sys.stderr)
    return 1 if unfounded is not None else 0


if __name__ == "__main__":
    sys.exit(main())

"""A longer run, or one input again: python -m tests.fuzz --seconds 600 --reader nerfstudio --output counts.json

Ends with the results of the inputs, and with status 1 if one got through.
"""

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

from tests.fuzz import campaign
from tests.fuzz.report import as_plain, summary


def main() -> int:
    """Returns: the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--reader", action="append", help="which; all if not given; may be given several times")
    parser.add_argument("--seconds", type=float, help="for how long, all readers together")
    parser.add_argument("--count", type=int, help="inputs for each reader")
    parser.add_argument("--seed", type=int, default=0, help="of the first input; the next ones follow")
    parser.add_argument("--module", default="tests.fuzz.readers", help="where READERS are")
    parser.add_argument("--output", type=Path, help="JSON file for the counts, the escapes and the versions")
    parser.add_argument("--folder", type=Path, help="keep the files there: data holds the last input")
    flags = parser.parse_args()
    if flags.seconds is None and flags.count is None:
        flags.count = 100
    begun = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="fuzz-") as temporary:
        base = flags.folder or Path(temporary)
        outcomes = campaign.run(
            flags.reader or campaign.names(flags.module), base, flags.seed, flags.count, flags.seconds, flags.module
        )
    seconds = time.monotonic() - begun
    print("\n".join(summary(outcomes)))
    escaped = [outcome for outcome in reversed(outcomes) if outcome.kind == "escaped"]
    escapes = {(outcome.reader, outcome.error, outcome.shape): outcome for outcome in escaped}  # the first of each kind
    for outcome in escapes.values():
        print(f"\n{outcome}")
    print(f"\n{len(outcomes):,} inputs in {seconds:.0f} s, {len(escapes)} ways to escape")
    if flags.output is not None:
        flags.output.write_text(json.dumps(as_plain(outcomes, seconds), indent=2) + "\n")
    return 1 if escapes else 0


if __name__ == "__main__":
    sys.exit(main())

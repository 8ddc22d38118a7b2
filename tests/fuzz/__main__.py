"""A longer run, or one input again: python -m tests.fuzz --seconds 600 --reader nerfstudio

Ends with what became of the inputs, and with status 1 where one got through.
"""

import argparse
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from tests.fuzz import campaign
from tests.fuzz.outcome import Outcome


def summary(outcomes: Sequence[Outcome]) -> list[str]:
    """Lines for people: how many inputs became what, and each kind of answer once, the most frequent first."""
    lines = []
    for reader in dict.fromkeys(outcome.reader for outcome in outcomes):
        own = [outcome for outcome in outcomes if outcome.reader == reader]
        kinds = Counter(outcome.kind for outcome in own)
        shapes = Counter((outcome.error, outcome.shape) for outcome in own if outcome.kind == "refused")
        became = f"{kinds['accepted']} accepted, {kinds['refused']} refused in {len(shapes)} ways"
        lines.append(f"{reader}: {len(own)} inputs, {became}, {kinds['escaped']} escaped")
        lines += [f"  {number:6,} {error}: {shape}" for (error, shape), number in shapes.most_common()]
    return lines


def main() -> int:
    """Returns: how many kinds of escapes there were, 1 at most."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--reader", action="append", help="which; all if not given; may be given several times")
    parser.add_argument("--seconds", type=float, help="for how long, all readers together")
    parser.add_argument("--count", type=int, help="inputs for each reader")
    parser.add_argument("--seed", type=int, default=0, help="of the first input; the next ones follow")
    parser.add_argument("--module", default="tests.fuzz.readers", help="where READERS are")
    parser.add_argument("--json", type=Path, help="file for all outcomes")
    parser.add_argument("--folder", type=Path, help="keep what is written there: data holds the last input")
    flags = parser.parse_args()
    if flags.seconds is None and flags.count is None:
        flags.count = 100
    with tempfile.TemporaryDirectory(prefix="fuzz-") as temporary:
        base = flags.folder or Path(temporary)
        outcomes = campaign.run(
            flags.reader or campaign.names(flags.module), base, flags.seed, flags.count, flags.seconds, flags.module
        )
    print("\n".join(summary(outcomes)))
    escaped = [outcome for outcome in reversed(outcomes) if outcome.kind == "escaped"]
    escapes = {(outcome.reader, outcome.error, outcome.shape): outcome for outcome in escaped}  # the first of each kind
    for outcome in escapes.values():
        print(f"\n{outcome}")
    print(f"\n{len(outcomes):,} inputs, {len(escapes)} ways to escape")
    if flags.json is not None:
        flags.json.write_text(json.dumps([asdict(outcome) for outcome in outcomes], indent=1) + "\n")
    return min(len(escapes), 1)


if __name__ == "__main__":
    sys.exit(main())

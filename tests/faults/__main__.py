"""Many faults, one after the other: python -m tests.faults --count 100 --output faults.json

Ends with the number of faults of each kind, and the ends of the runs; with status 1 if anything was lost, or a run did
not end as an undisturbed one.
"""

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

from nerfloom.training.machine import machine
from tests.faults import campaign


def main() -> int:
    """Returns: the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    parser.add_argument("--count", type=int, default=30, help="faults; each takes a few seconds")
    parser.add_argument("--seed", type=int, default=0, help="of the moments and the order")
    parser.add_argument("--fault", action="append", choices=list(campaign.FAULTS), help="which; all if not given")
    parser.add_argument("--output", type=Path, help="JSON file for the counts and the versions")
    flags = parser.parse_args()
    faults = {name: campaign.FAULTS[name] for name in flags.fault or campaign.FAULTS}
    begun = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="faults-") as temporary:
        report = campaign.run(Path(temporary), flags.count, flags.seed, faults)
    found = {
        **report.as_plain(),
        "seed": flags.seed,
        "seconds": round(time.monotonic() - begun, 1),
        "machine": machine(),
    }
    for name, number in found["faults"].items():
        print(f"{number:6,} {name}")
    print(
        f"{found['injected']:,} faults in {found['runs']} runs and {found['seconds']:.0f} s; "
        f"after {found['committed_lost']} of them something committed was lost; "
        f"{found['runs_with_the_same_end']} runs ended with the bits of an undisturbed one"
    )
    print("\n".join(report.problems), end="\n" if report.problems else "")
    if flags.output is not None:
        flags.output.write_text(json.dumps(found, indent=2) + "\n")
    return 1 if report.problems or not report.injected else 0


if __name__ == "__main__":
    sys.exit(main())

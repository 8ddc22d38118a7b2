"""`python -m tests.release` (`make release-check`): everything that is checked before a release.

Needs the packages of the extra `release`. Nothing is uploaded, and nothing but build tools is downloaded.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

from tests.release.archives import check_sdist, check_wheel
from tests.release.build import build, check_metadata
from tests.release.install import Environment, check_without_compiler
from tests.release.problem import Problem
from tests.release.sources import check_sources


def release_check(folder: Path, data: Path | None, seconds: int) -> None:
    """Run all checks, one after the other; each prints a line."""
    for line in check_sources():
        print(line, flush=True)
    sdist, wheel = build(folder / "dist")
    print(f"built: {sdist.name}, {wheel.name}", flush=True)
    print(check_metadata(sdist, wheel), flush=True)
    print(check_sdist(sdist), flush=True)
    print(check_wheel(wheel), flush=True)
    used = Environment(folder / "wheel", wheel).use(data, f"--max-seconds {seconds}")
    print(f"the wheel, installed and used without a compiler: {used}", flush=True)
    used = Environment(folder / "sdist", sdist).use(None, "--max-num-iterations 200")
    print(f"the sdist, with a compiler: {used}", flush=True)
    print(f"the sdist, without one: {check_without_compiler(folder / 'without', sdist)}", flush=True)


def main() -> int:
    """Run the command; the exit status is 1 if something is wrong."""
    parser = argparse.ArgumentParser(prog="python -m tests.release", description=__doc__)
    parser.add_argument("--data", type=Path, help="data set to train on; the embedded scene if not given")
    parser.add_argument("--seconds", type=int, default=20, help="how long to train with the installed wheel")
    parser.add_argument("--keep", type=Path, help="folder to build and install in; a temporary one if not given")
    arguments = parser.parse_args()
    start = time.perf_counter()
    try:
        if arguments.keep is not None:
            arguments.keep.mkdir(parents=True, exist_ok=True)
            release_check(arguments.keep.resolve(), arguments.data and arguments.data.resolve(), arguments.seconds)
        else:
            with tempfile.TemporaryDirectory(prefix="nerfloom-release-") as folder:
                release_check(Path(folder), arguments.data and arguments.data.resolve(), arguments.seconds)
    except Problem as problem:
        print(f"not ready for a release: {problem}", file=sys.stderr)
        return 1
    print(f"ready for a release, as far as this machine can tell ({time.perf_counter() - start:.0f} s)")
    return 0


if __name__ == "__main__":
    sys.exit(main())

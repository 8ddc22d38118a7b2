"""`python -m tests.sanitize` (`make sanitize`): the kernels' tests, on kernels built with sanitizers."""

import sys

from tests.sanitize.build import Missing, build
from tests.sanitize.check import check

if __name__ == "__main__":
    try:
        sys.exit(check(build()))
    except Missing as missing:
        sys.exit(f"nothing was checked: {missing}")

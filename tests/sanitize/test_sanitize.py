"""The kernels neither read nor write where they must not, and no sum in them overflows."""

import subprocess
import sys

import pytest

from tests.patience import PATIENCE
from tests.sanitize.build import ROOT, Missing, runtime


@pytest.mark.slow
def test_the_kernels_tests_pass_under_sanitizers() -> None:
    try:
        runtime()
    except Missing as missing:
        pytest.skip(str(missing))
    run = [sys.executable, "-m", "tests.sanitize"]
    done = subprocess.run(run, cwd=ROOT, capture_output=True, text=True, timeout=3 * PATIENCE, check=False)
    last = (done.stdout.strip().splitlines() or [""])[-1]
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    assert last.endswith("with address, undefined and library assertions: nothing found")

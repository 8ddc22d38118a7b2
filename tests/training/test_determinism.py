"""Same seed and thread count, same bits: in processes that know nothing of each other. See docs/stability.md."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.training.helpers import TINY

ROOT = Path(__file__).parents[2]


def hashes(data: Path, folder: Path, threads: int, **environment: str) -> dict[str, str]:
    """What every small method comes to (`tests.training.bits`) in a process of its own."""
    words = [sys.executable, "-m", "tests.training.bits", str(data), str(folder), str(threads)]
    around = {**os.environ, **environment}
    done = subprocess.run(words, capture_output=True, text=True, cwd=ROOT, env=around, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("threads", "kernels"),
    [(1, "auto"), (2, "auto"), (1, "reference")],  # with threads torch alone adds in any order
)
def test_two_processes_come_to_the_same_bits(threads: int, kernels: str, shared_tiny: Path, tmp_path: Path) -> None:
    """Whatever order Python's sets have in them."""
    first, second = (
        hashes(shared_tiny, tmp_path / seed, threads, PYTHONHASHSEED=seed, NERFLOOM_KERNELS=kernels)
        for seed in ("1", "2")
    )
    assert list(first) == list(TINY)
    assert first == second
    assert len(set(first.values())) == len(TINY)

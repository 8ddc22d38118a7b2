"""Triton's kernels, by its interpreter: the tests in tests/kernels/triton, in a process of their own.

Triton must know before it is imported whether it interprets, and the other tests must not be affected.
"""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from nerfloom.kernels import native, triton_backend
from tests.forked import Forks

ROOT = Path(__file__).parents[2]
needs_triton = pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="triton is not installed")


def python(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    given = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", **environment}
    return subprocess.run([sys.executable, *words], env=given, capture_output=True, text=True, check=False, cwd=ROOT)


@needs_triton
@pytest.mark.parametrize(
    "which", [pytest.param("not slow", marks=pytest.mark.medium), pytest.param("slow", marks=pytest.mark.slow)]
)
def test_every_kernel_computes_what_its_reference_does(which: str) -> None:
    words = "-m", "pytest", "-q", "-s", "-p", "no:cacheprovider", "-p", "no:xdist", "-m", which, "tests/kernels/triton"
    done = python(*words, TRITON_INTERPRET="1", NERFLOOM_KERNELS="triton")
    print(done.stdout)
    assert done.returncode == 0, done.stdout[-8000:]
    assert "passed" in done.stdout


@needs_triton
@pytest.mark.slow
@pytest.mark.parametrize("target", [("cuda", "80"), ("hip", "gfx942")], ids=" ".join)
def test_every_kernel_compiles_for_a_gpu_that_is_not_there(target: tuple[str, str], tmp_path: Path) -> None:
    done = python(
        "-m", "tests.kernels.triton.compile_all", *target, TRITON_INTERPRET="0", TRITON_CACHE_DIR=str(tmp_path)
    )
    print(done.stdout)
    assert done.returncode == 0, done.stderr[-4000:]
    started = {
        f"{file.stem}.{name}"
        for file in (ROOT / "framework" / "kernels").glob("*/*_triton.py")
        for name in re.findall(r"\blaunch\(\s*(_\w+),", file.read_text(encoding="utf-8"))
    }
    assert started <= set(done.stdout.split())
    assert len(started) > 30


def test_triton_is_imported_by_no_user_of_the_cpu(forks: Forks) -> None:
    code = (
        "import sys, torch\n"
        "from nerfloom.kernels.grids.hash_grid import HashGridLayout, hash_grid\n"
        "layout = HashGridLayout.build(2, 2, 4, 6)\n"
        "hash_grid(torch.rand(3, 3), torch.rand(layout.num_entries, 2), layout)\n"
        "print('triton' in sys.modules, any(name.endswith('_triton') for name in sys.modules))"
    )
    done = forks.run(code, TRITON_INTERPRET="0")
    assert done.stdout.split() == ["False", "False"], done.stderr


def test_asking_for_triton_without_a_gpu_is_an_error(forks: Forks) -> None:
    code = "from nerfloom.kernels import triton_backend as t; print(t.available())"
    assert forks.run(code, NERFLOOM_KERNELS="reference").stdout.split() == ["False"]
    done = forks.run(code, NERFLOOM_KERNELS="triton", TRITON_INTERPRET="0", CUDA_VISIBLE_DEVICES="")
    assert done.returncode == 1
    assert "NERFLOOM_KERNELS asks for 'triton', but " in done.stderr


def test_the_processors_kernels_come_first() -> None:
    """Also while Triton interprets, unless they are left out."""
    from nerfloom.kernels.compositing.density import COMPOSITE

    names = [implementation.backend.name for implementation in COMPOSITE.implementations]
    assert names == ["c++", "triton"]
    if native.available() and not triton_backend.INTERPRETED:
        import torch

        assert COMPOSITE.choose((torch.rand(3),)).backend.name == "c++"

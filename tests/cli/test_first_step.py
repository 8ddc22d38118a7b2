"""The way to the first training step: what it must not import, since each of these takes a second or more."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.helpers import TINY_NGP

FIRST_STEP = """
import sys
from framework.training.trainer import Trainer

train_step = Trainer.train_step

class Stepped(BaseException):
    pass

def first_step(self):
    train_step(self)
    print(*sys.modules, flush=True)
    raise Stepped

Trainer.train_step = first_step
from framework.cli.train import main

words = sys.argv[1:]
for vis in ("none", "tensorboard"):
    sys.argv = ["ns-train", *words, "--vis", vis, "--timestamp", vis]
    try:
        main()
    except Stepped:
        pass
"""
"""A program that runs ns-train up to the end of its first step, twice, and prints the modules imported by then."""
SLOW = {
    "torch._dynamo", "torch._inductor", "torch.utils.tensorboard", "tensorboard", "tensorflow", "scipy", "matplotlib",
    "skimage", "sklearn", "pandas", "cv2", "trimesh", "viser", "jinja2", "pycolmap", "plotly", "torchvision", "lpips",
}  # fmt: skip
"""Modules that take long to import, and that the first step does not need."""


@pytest.mark.medium
def test_what_is_imported_before_the_first_step(shared_tiny: Path, tmp_path: Path) -> None:
    """Also with TensorBoard's files: what that alone imports comes after what is imported without."""
    words = ["instant-ngp", "--data", shared_tiny, "--output-dir", tmp_path, *TINY_NGP]
    done = subprocess.run(
        [sys.executable, "-c", FIRST_STEP, *map(str, words)],
        capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    without, with_files = (set(line.split()) for line in done.stdout.splitlines())
    for imported in (without, with_files):
        assert "framework.training.step" in imported
        assert imported & SLOW == set()

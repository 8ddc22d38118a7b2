"""The way to the first training step: what it must not import, since each of these takes a second or more."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.helpers import TINY_NGP

FIRST_STEP = """
import os, sys
from framework.training.trainer import Trainer

train_step = Trainer.train_step

def first_step(self):
    train_step(self)
    print(*sys.modules, flush=True)
    os._exit(0)

Trainer.train_step = first_step
from framework.cli.train import main

sys.argv = ["ns-train", *sys.argv[1:]]
main()
"""
"""A program that runs ns-train up to the end of its first step, and prints the modules that it has imported by then."""
SLOW = {
    "torch._dynamo", "torch._inductor", "torch.utils.tensorboard", "tensorboard", "tensorflow", "scipy", "matplotlib",
    "skimage", "sklearn", "pandas", "cv2", "trimesh", "viser", "jinja2", "pycolmap", "plotly", "torchvision", "lpips",
}  # fmt: skip
"""Modules that take long to import, and that the first step does not need."""


@pytest.mark.medium
@pytest.mark.parametrize("vis", ["none", "tensorboard"])
def test_what_is_imported_before_the_first_step(vis: str, shared_tiny: Path, tmp_path: Path) -> None:
    words = ["instant-ngp", "--data", shared_tiny, "--output-dir", tmp_path, *TINY_NGP, "--vis", vis]
    done = subprocess.run(
        [sys.executable, "-c", FIRST_STEP, *map(str, words)],
        capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    imported = set(done.stdout.split())
    assert "framework.training.step" in imported
    assert imported & SLOW == set()

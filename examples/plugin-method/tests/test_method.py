"""dense-grid keeps what Nerfloom asks of every method, and trains."""

from __future__ import annotations

import dataclasses
import os
import subprocess
from pathlib import Path

from nerfloom.base.child import python_command
from nerfloom.registry import load_method
from nerfloom.testing import assert_method


def test_it_keeps_what_every_method_must() -> None:
    """With small grids, so that it takes seconds."""
    method = load_method("dense-grid")
    small = dataclasses.replace(method.config, max_resolution=32, grid_resolution=32, num_steps=64)
    assert_method(method, "dense-grid", small)


def test_ten_steps_on_the_embedded_scene(tmp_path: Path) -> None:
    """As a person would start them."""
    small = "--max-resolution 32 --grid-resolution 32 --num-steps 64 --samples-per-batch 4096 --max-eval-images 1"
    flags = [*small.split(), "--max-num-iterations", "10", "--vis", "none", "--output-dir", str(tmp_path)]
    command = python_command("nerfloom.cli.train", "dense-grid", *flags)
    environment = {**os.environ, "NERFLOOM_CACHE": str(tmp_path / "cache")}
    subprocess.run([*command, "procedural", "--size", "24", "--num-train", "8"], check=True, env=environment)
    assert list(tmp_path.rglob("step-000000010.ckpt"))

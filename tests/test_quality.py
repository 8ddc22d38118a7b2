"""Whole trainings against exact geometry and real photographs: does it really work?"""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from nerfloom.data.parsed_scene import DataParser
from nerfloom.dataparsers.blender import Blender
from nerfloom.dataparsers.procedural import Procedural
from nerfloom.evaluation.evaluator import evaluate
from nerfloom.registry import load_method
from nerfloom.training.datasets import load_split
from nerfloom.training.run import Run, create_folder
from nerfloom.training.trainer import Trainer

pytestmark = pytest.mark.slow


def trained(parser: DataParser, data: Path | None, folder: Path, steps: int) -> tuple[Trainer, Run]:
    config = dataclasses.replace(
        load_method("instant-ngp").config, data=data, max_num_iterations=steps, vis="none", grid_resolution=64
    )
    run = Run("instant-ngp", config, "", parser, folder)
    create_folder(run)
    trainer = Trainer.of(run, load_split(run, "train"))
    trainer.train()
    return trainer, run


def test_the_embedded_scene_in_colour_and_depth(tmp_path: Path) -> None:
    """The depth was never shown to the network; the scene knows it exactly."""
    parser = Procedural(size=100, num_train=60)
    trainer, run = trained(parser, None, tmp_path / "run", steps=600)
    test_set = load_split(run, "test")
    psnr = evaluate(trainer.model, test_set, max_images=8).results["psnr"]
    errors, opacity_errors = [], []
    for index in range(0, 16, 2):
        view = trainer.model.render_view(test_set.view(index), trainer.model.background)
        path = parser.parse(None, "test").image_paths[index]
        with np.load(path.with_name(f"{path.stem}_geometry.npz")) as geometry:
            truth = torch.from_numpy(geometry["depth"])
        alpha = test_set.image(index)[..., 3].float() / 255
        solid = torch.isfinite(truth) & (alpha == 1)
        errors.append((view.median_depth - truth)[solid].abs())
        opacity_errors.append((view.accumulation - alpha).abs())
    depth = torch.cat(errors).median().item()
    opacity = torch.cat([e.flatten() for e in opacity_errors]).mean().item()
    print(f"embedded scene, 600 steps: {psnr:.2f} dB, median depth error {depth:.4f}, mean opacity error {opacity:.4f}")
    assert psnr > 24
    assert depth < 0.02
    assert opacity < 0.02


@pytest.mark.data
def test_real_lego_reduced(real_data: Path, tmp_path: Path) -> None:
    trainer, run = trained(Blender(downscale_factor=4), real_data / "lego", tmp_path / "run", steps=600)
    found = evaluate(trainer.model, load_split(run, "test"), max_images=10)
    print(f"lego at 100x100, 600 steps: {found.line()}")
    assert found.results["psnr"] > 24

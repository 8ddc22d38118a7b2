"""Losses that are learnt in one call, and those that are not."""

import dataclasses
from pathlib import Path

import pytest
import torch

from framework.data.pixels import PixelBatch
from framework.kernels.native import available
from framework.kernels.traced_error import TracedError
from framework.ray_model import RayModel
from framework.training.trainer import Trainer
from tests.training.helpers import tiny_trainer


def losses(trainer: Trainer, steps: int = 4) -> list[float]:
    return [trainer.train_step().losses["rgb"] for _ in range(steps)]


@pytest.mark.parametrize("rays_per_pixel", [1, 4])
def test_steps_are_those_of_single_operations(
    shared_tiny: Path, tmp_path: Path, rays_per_pixel: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {"thin_gradients": 0.0, "rays_per_pixel": rays_per_pixel, "train_rays_per_pixel_from": 0.0}
    together = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "a", **settings)
    assert together.model.field.grid_color() is not None
    found = losses(together)
    monkeypatch.setattr(RayModel, "_traced", lambda self, batch: None)
    apart = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "b", **settings)
    assert found == pytest.approx(losses(apart), rel=2e-3 if available() else 1e-5)


@pytest.mark.parametrize(
    "settings",
    [
        {"depth_loss_mult": 0.5},
        {"occlusion_loss_mult": 0.1, "few_images": True},
        {"unseen_loss_mult": 0.1, "few_images": True},
        {"open_levels_until": 1.0, "few_images": True},
        {"background_model": "contraction"},
        {"gradient_scaling": True},
    ],
    ids=str,
)
def test_other_losses_and_fields_are_not_left_out(
    shared_tiny: Path, tmp_path: Path, settings: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the one call does not know is computed by single operations."""
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "b", **settings)
    seen, usual = [], RayModel._traced

    def watched(self: RayModel, batch: PixelBatch) -> TracedError | None:
        seen.append((batch, usual(self, batch)))
        return seen[-1][1]

    monkeypatch.setattr(RayModel, "_traced", watched)
    trainer.train_step()
    (batch, found), *_ = seen
    if "depth_loss_mult" in settings:  # without known distances there is no such loss
        assert found is not None
        batch = dataclasses.replace(batch, distances=torch.ones(len(batch)))
        found = usual(trainer.model, batch)
    assert found is None


@pytest.mark.parametrize("method", ["instant-ngp", "kplanes", "nerfacto"])
def test_thinned_steps_learn_as_well(method: str, shared_tiny: Path, tmp_path: Path) -> None:
    means = []
    for thin in (0.0, 0.5):
        trainer = tiny_trainer(method, shared_tiny, tmp_path / str(thin), thin_gradients=thin)
        found = losses(trainer, 40)
        assert sum(found[-5:]) < sum(found[:5]) / 2
        means.append(sum(found[-10:]))
    assert means[1] == pytest.approx(means[0], rel=0.3)

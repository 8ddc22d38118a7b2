"""Losses that are learnt in one call, and those that are not."""

import dataclasses
from pathlib import Path

import pytest
import torch
from torch import Tensor

from nerfloom.data.pixels import PixelBatch
from nerfloom.kernels.native import available
from nerfloom.kernels.traced_error import TracedError
from nerfloom.ray_model import RayModel
from nerfloom.training.trainer import Trainer
from tests.training.helpers import tiny_trainer


def losses(trainer: Trainer, steps: int = 4) -> list[float]:
    return [trainer.train_step().losses["rgb"] for _ in range(steps)]


def traced(trainer: Trainer) -> TracedError | None:
    """What the trainer's model learns of its next batch in one call; None if in several."""
    trainer.prepare()
    return trainer.model._traced(trainer.source.draw(trainer._request()))


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


@pytest.mark.parametrize(
    ("settings", "together"),
    [({}, True), ({"distortion_loss_mult": 0.01}, False), ({"predict_normals": True}, False)],
    ids=str,
)
def test_nerfacto_in_a_box_learns_in_one_call_if_it_adds_nothing(
    shared_tiny: Path, tmp_path: Path, settings: dict[str, object], together: bool
) -> None:
    trainer = tiny_trainer("nerfacto", shared_tiny, tmp_path, sampler="occupancy", samples_per_batch=4096, **settings)
    found = traced(trainer)
    assert (found is not None) == together


def test_terms_of_a_class_of_ones_own_are_not_left_out(shared_tiny: Path, tmp_path: Path) -> None:
    """Neither with the answer of the class that it derives from, nor if they are given to one model alone."""
    trainer = tiny_trainer("nerfacto", shared_tiny, tmp_path, sampler="occupancy", samples_per_batch=4096)
    model, kind = trainer.model, type(trainer.model)

    def regularizers(*_: object) -> dict[str, Tensor]:
        return {"own": next(model.field.parameters()).square().mean()}

    assert traced(trainer) is not None
    model.__class__ = type("Own", (kind,), {"regularizers": regularizers})
    assert traced(trainer) is None
    assert "own" in trainer.train_step().losses
    model.__class__ = type("Silent", (kind,), {"regularizers": regularizers, "regularized": False})
    assert traced(trainer) is not None
    model.__class__ = kind
    model.regularizers = regularizers
    assert traced(trainer) is None

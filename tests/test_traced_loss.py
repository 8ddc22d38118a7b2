"""Losses that are computed in one call, and losses that are not."""

import dataclasses
from pathlib import Path

import pytest
import torch
from torch import Tensor

from nerfloom import ray_model
from nerfloom.kernels.native import available
from nerfloom.kernels.traced.squared_error import TracedError
from nerfloom.losses.term import LossTerm, RenderedBatch
from nerfloom.losses.terms import ColorError
from nerfloom.training.trainer import Trainer
from tests.training.helpers import tiny_trainer


def losses(trainer: Trainer, steps: int = 4) -> list[float]:
    return [trainer.train_step().losses["rgb"] for _ in range(steps)]


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[TracedError | None]:
    """The result of one call, or None if a part does not fit, for each step that asked for it."""
    found, usual = [], ray_model.error_of_traced
    monkeypatch.setattr(ray_model, "error_of_traced", lambda *a: found.append(usual(*a)) or found[-1])
    return found


def traced(trainer: Trainer, calls: list[TracedError | None]) -> bool:
    """Whether a step of the trainer is learnt in one call."""
    calls.clear()
    trainer.train_step()
    return any(call is not None for call in calls)


@pytest.mark.parametrize("rays_per_pixel", [1, 4])
def test_steps_are_those_of_single_operations(
    shared_tiny: Path, tmp_path: Path, rays_per_pixel: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {"thin_gradients": 0.0, "rays_per_pixel": rays_per_pixel, "train_rays_per_pixel_from": 0.0}
    together = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "a", **settings)
    assert together.model.field.grid_color() is not None
    found = losses(together)
    monkeypatch.setattr(ray_model, "error_of_traced", lambda *_: None)
    apart = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "b", **settings)
    assert found == pytest.approx(losses(apart), rel=2e-3 if available() else 1e-5)


@pytest.mark.parametrize(
    "settings",
    [
        {"depth_loss_mult": 0.5},
        {"occlusion_loss_mult": 0.1, "few_images": True},
        {"open_levels_until": 1.0, "few_images": True},
        {"background_model": "contraction"},
        {"gradient_scaling": True},
    ],
    ids=str,
)
def test_other_losses_and_fields_are_not_left_out(
    shared_tiny: Path, tmp_path: Path, settings: dict[str, object], calls: list[TracedError | None]
) -> None:
    """Single operations compute terms that the one call does not know."""
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "b", **settings)
    known = "depth_loss_mult" in settings  # without known distances there is no such loss
    assert traced(trainer, calls) == known
    if known:
        batch = trainer.source.draw(trainer._request())
        calls.clear()
        loss = trainer.model.loss(dataclasses.replace(batch, distances=torch.ones(len(batch))), 0)
        assert set(loss.terms) == {"rgb", "depth"}
        assert not calls


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
    shared_tiny: Path, tmp_path: Path, settings: dict[str, object], together: bool, calls: list[TracedError | None]
) -> None:
    trainer = tiny_trainer("nerfacto", shared_tiny, tmp_path, sampler="occupancy", samples_per_batch=4096, **settings)
    assert traced(trainer, calls) == together


class Smallness(LossTerm):
    """Mean square of the first parameter."""

    def __call__(self, shown: RenderedBatch) -> Tensor:
        return next(shown.model.field.parameters()).square().mean()


def test_a_class_of_ones_own_says_that_its_colours_are_the_usual_ones(
    shared_tiny: Path, tmp_path: Path, calls: list[TracedError | None]
) -> None:
    """A missing declaration is not inherited from the base class."""
    trainer = tiny_trainer("nerfacto", shared_tiny, tmp_path, sampler="occupancy", samples_per_batch=4096)
    model, kind = trainer.model, type(trainer.model)
    assert traced(trainer, calls)

    class Silent(kind):
        pass

    class Says(kind, plain=True):
        pass

    class Adds(kind, plain=True):
        losses = (*kind.losses, Smallness("own"))

    class Weighs(kind, plain=True):
        losses = (ColorError(weight=2.0),)

    for made, together in ((Silent, False), (Says, True), (Adds, False), (Weighs, False)):
        model.__class__ = made
        assert traced(trainer, calls) == together, made
    model.__class__ = Adds
    assert set(trainer.train_step().losses) == {"rgb", "own"}

"""Few images: when their regularisers are used, a run's report on them, and the values of their terms."""

import dataclasses
import re
from pathlib import Path
from typing import Any

import pytest
import torch

from nerfloom.losses.few_images import MAX_FEW, MAX_FEW_WITH_ALPHA, FewImagesConfig
from nerfloom.registry import load_method
from nerfloom.training.trainer import Trainer
from tests.training.helpers import assert_same_bits, tensors, tiny_trainer
from tests.truth.test_training import SCENE

METHODS = ("instant-ngp", "kplanes", "nerfacto", "tensorf", "vanilla-nerf")
CAPTURE = dataclasses.replace(
    SCENE, has_alpha=False, unbounded=True, near=0.5, far=1000.0, camera_to_worlds=torch.eye(4)[:3].expand(3, 3, 4)
)


def decided(method: str, count: int, scene: Any = CAPTURE, **settings: Any) -> tuple[FewImagesConfig, str]:
    loaded, scene = load_method(method), dataclasses.replace(scene, num_cameras=count)
    config, made = loaded.decide(dataclasses.replace(loaded.config, **settings), scene)
    assert isinstance(config, FewImagesConfig)
    return config, "\n".join(decision.line() for decision in made)


def parts(config: FewImagesConfig) -> tuple[float, float]:
    return config.open_levels_until, config.occlusion_loss_mult


@pytest.mark.parametrize("method", METHODS)
def test_few_images_of_a_capture_are_recognised(method: str) -> None:
    few, said = decided(method, MAX_FEW)
    assert few.few_images
    assert any(parts(few))
    assert f"regularisers for few images: on, as there are {MAX_FEW} training images" in said
    assert "(else: --few-images False)" in said
    many, said = decided(method, MAX_FEW + 1)
    assert not many.few_images
    assert parts(many) == (0, 0)
    assert not re.search("few images|occlusion|levels", said)


def test_a_flag_turns_them_off_and_on() -> None:
    off, said = decided("nerfacto", 3, few_images=False)
    assert parts(off) == (0, 0)
    assert "few images" not in said
    on, _ = decided("nerfacto", 500, few_images=True)
    assert parts(on) == parts(decided("nerfacto", 3)[0])


def test_each_part_has_a_flag() -> None:
    for name in ("open_levels_until", "occlusion_loss_mult"):
        config, said = decided("nerfacto", 3, **{name: 0.25})
        assert getattr(config, name) == 0.25
        assert name.replace("_", " ") not in said


def test_alpha_shows_what_is_empty_so_that_fewer_images_are_few() -> None:
    """And grids, which open no levels, then have nothing to switch on."""
    for count, few in ((MAX_FEW_WITH_ALPHA, True), (MAX_FEW_WITH_ALPHA + 1, False)):
        config, _ = decided("vanilla-nerf", count, dataclasses.replace(SCENE, has_alpha=True))
        assert config.few_images == few
        assert parts(config) == (0.5 * few, 0)
    assert not decided("instant-ngp", 3, dataclasses.replace(SCENE, has_alpha=True))[0].few_images


def test_few_images_of_a_moving_scene_are_not_recognised() -> None:
    assert not decided("kplanes", 3, dataclasses.replace(CAPTURE, moving=True))[0].few_images


def stepped(trainer: Trainer, steps: int = 3) -> dict[str, float]:
    """Terms of the loss after some steps."""
    for _ in range(steps):
        report = trainer.train_step()
    return {name: float(value) for name, value in report.terms.items()}


@pytest.mark.parametrize("method", METHODS)
def test_the_term_is_there_where_it_is_asked_for(method: str, shared_tiny: Path, tmp_path: Path) -> None:
    """The near part is the whole scene here, so that it has density."""
    asked = {"occlusion_loss_mult": 1.0, "occlusion_range": 3.0}
    assert stepped(tiny_trainer(method, shared_tiny, tmp_path / "with", **asked))["occlusion"] > 0
    assert "occlusion" not in stepped(tiny_trainer(method, shared_tiny, tmp_path / "without"))


@pytest.mark.medium
def test_matter_before_cameras_goes_away(shared_tiny: Path, tmp_path: Path) -> None:
    """The whole ball is `near` here and its penalty large: the picture is given up for empty space."""
    settings = {"silhouette_cells": False, "max_num_iterations": 200}
    terms = [
        stepped(
            tiny_trainer(
                "instant-ngp",
                shared_tiny,
                tmp_path / f"{mult}",
                occlusion_loss_mult=mult,
                occlusion_range=3.0,
                **settings,
            ),
            40,
        )["occlusion"]
        / mult
        for mult in (1e-6, 1.0)
    ]
    assert terms[1] < 0.2 * terms[0]


def test_with_many_images_not_a_bit_changes(shared_tiny: Path, tmp_path: Path) -> None:
    """Ten images with alpha are not few: a run equals one with all terms switched off, random numbers included."""
    runs = [{}, {"few_images": False}, {"open_levels_until": 0.0, "occlusion_loss_mult": 0.0}]
    trainers = [tiny_trainer("instant-ngp", shared_tiny, tmp_path / str(i), **run) for i, run in enumerate(runs)]
    for trainer in trainers:
        stepped(trainer)
    for other in trainers[1:]:
        assert_same_bits(tensors(trainers[0]), tensors(other))


def test_a_profile_says_it(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("vanilla-nerf", shared_tiny, tmp_path / "run", max_train_images=3)
    said = "\n".join(trainer.profile.lines())
    assert "scene: 3 images" in said
    assert "regularisers for few images: on, " in said
    assert "open levels until: 0.5, " in said

"""Before the first step: what the scene's profile says, and what the photographs' silhouettes save."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from framework.base.config import TrainConfig
from framework.base.console import say
from framework.base.decisions import Decision
from framework.cameras.ndc import NdcCameras
from framework.data.dataset import Dataset
from framework.data.pixel_set import PixelSet
from framework.data.pixels import training_background
from framework.model import HasAppearance, LearnsMotion, Model, RefinesPoses, parts
from framework.samplers.base import SkipsCells
from framework.samplers.choice import SamplingConfig
from framework.scene.profile import SceneProfile
from framework.scene.silhouettes import Silhouettes, pixels_near, visual_hull


def profile_of(
    method: str, config: TrainConfig, model: Model[Any], dataset: Dataset, decided: Sequence[Decision]
) -> SceneProfile:
    """Return what the scene needs, and why.

    Args:
        method: its name, for people.
        config: the run's settings.
        model: what will be trained.
        dataset: images to learn from.
        decided: what the method decided by the data.
    """
    scene, decisions = model.scene, []
    if dataset.opaque is not None and config.masks == "auto":
        reason = "they cut away over half of the pixels, of each photograph others"
        decisions.append(Decision("masks", "what they do not keep is empty", f"{reason} (else: --masks ignored)"))
    if config.background == "auto":
        reason = f"{'the photographs have' if scene.has_alpha else 'no photograph has'} alpha"
        decisions.append(Decision("background", training_background(config.background, scene.has_alpha), reason))
    if isinstance(config, SamplingConfig) and config.silhouette_cells and parts(model, SkipsCells):
        obstacle = _no_silhouettes(dataset)
        outside = "what is outside all of them" if scene.moving else "space outside them"
        choice = "not used" if obstacle else f"{outside} is skipped from the start"
        decisions.append(Decision("silhouettes", choice, obstacle or "alpha shows them"))
    if scene.moving and not isinstance(model, LearnsMotion):
        decisions.append(Decision("times", "ignored", f"{method} learns a still scene: what moves blurs"))
    if scene.appearance_varies and not isinstance(model, HasAppearance):
        decisions.append(Decision("light that differs", "ignored", f"{method} learns one light for all photographs"))
    if scene.poses == "device" and not isinstance(model, RefinesPoses):
        decisions.append(Decision("the device's poses", "not refined", f"{method} takes poses as they are"))
    return SceneProfile.of(dataset, [*decisions, *decided])


def skip_by_silhouettes(config: TrainConfig, model: Model[Any], dataset: Dataset, fresh: bool) -> Dataset:
    """Empty the occupancy grids by the images' silhouettes.

    Args:
        config: the run's settings.
        model: whose samplers are told.
        dataset: images to learn from.
        fresh: the run begins; else the grids come from a checkpoint and are left as they are.
    Returns: the data set without pixels that see nothing but emptied cells.
    """
    samplers = parts(model, SkipsCells)
    if not samplers or not isinstance(config, SamplingConfig) or not config.silhouette_cells:
        return dataset
    if _no_silhouettes(dataset) is not None:
        return dataset
    silhouettes, moving = Silhouettes.of(dataset), model.scene.moving
    if fresh:
        hulls = [visual_hull(silhouettes, sampler.box, sampler.resolution, moving) for sampler in samplers]
        if not all(bool(hull.any()) for hull in hulls):
            say("warning: the photographs' alpha leaves no part of the box; it is not used to skip anything")
            return dataset
        for sampler, hull in zip(samplers, hulls, strict=True):
            sampler.carve(hull)
    # Of a scene that moves, a pixel that is empty at its time teaches about cells that are full at others.
    if not config.silhouette_pixels or moving or not all(bool(sampler.carved.any()) for sampler in samplers):
        return dataset
    near = [pixels_near(silhouettes, ~s.carved, s.box, s.resolution) for s in samplers]
    return dataset.drawing(PixelSet.shared(near, 1))


def _no_silhouettes(dataset: Dataset) -> str | None:
    """Why the photographs' alpha cannot tell what is empty; None where it can."""
    if not dataset.scene.has_alpha:
        return "no photograph has alpha"
    if isinstance(dataset.cameras, NdcCameras):
        return "the box is in normalised device coordinates"
    camera = dataset.cameras.model
    return None if camera == "pinhole" else f"the camera is {camera}, not pinhole"

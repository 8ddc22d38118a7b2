"""Preparation of training: the scene's profile, and space that the images' silhouettes show to be empty."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor

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
from framework.scene.silhouettes import Silhouettes, moving_hulls, pixels_near, visual_hull


def profile_of(
    method: str, config: TrainConfig, model: Model[Any], dataset: Dataset, decided: Sequence[Decision]
) -> SceneProfile:
    """Return the profile of the scene, with each setting that was chosen by the data and the reason.

    Args:
        method: the method's name.
        config: the run's settings.
        model: the model to train.
        dataset: the training images.
        decided: settings that the method chose by the data.
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
        outside = "what is outside all of them at its time" if scene.moving else "space outside them"
        choice = "not used" if obstacle else f"{outside} is skipped from the start"
        decisions.append(Decision("silhouettes", choice, obstacle or "alpha shows them"))
    if scene.moving and not isinstance(model, LearnsMotion):
        decisions.append(Decision("times", "ignored", f"{method} learns a still scene: moving objects are blurred"))
    if scene.appearance_varies and not isinstance(model, HasAppearance):
        decisions.append(Decision("light that differs", "ignored", f"{method} learns one light for all photographs"))
    if scene.poses == "device" and not isinstance(model, RefinesPoses):
        decisions.append(Decision("the device's poses", "not refined", f"{method} takes poses as they are"))
    return SceneProfile.of(dataset, [*decisions, *decided])


def skip_by_silhouettes(config: TrainConfig, model: Model[Any], dataset: Dataset, fresh: bool) -> Dataset:
    """Empty the cells of the occupancy grids that are outside the images' silhouettes.

    Args:
        config: the run's settings.
        model: the model, whose samplers hold the grids.
        dataset: the training images.
        fresh: whether training starts; if not, the grids come from a checkpoint and are not changed.

    Returns:
        The data set, without pixels whose rays meet emptied cells only.
    """
    samplers = parts(model, SkipsCells)
    if not samplers or not isinstance(config, SamplingConfig) or not config.silhouette_cells:
        return dataset
    if _no_silhouettes(dataset) is not None:
        return dataset
    silhouettes, moving = Silhouettes.of(dataset), model.scene.moving
    if fresh:
        hulls = [_hull(silhouettes, sampler, dataset.times) for sampler in samplers]
        if not all(bool(hull.any()) for hull in hulls):
            say("warning: the photographs' alpha leaves no part of the box; it is not used to skip anything")
            return dataset
        for sampler, hull in zip(samplers, hulls, strict=True):
            sampler.carve(hull)
    # In a moving scene, a pixel that is empty at its time supervises cells that are occupied at other times.
    if not config.silhouette_pixels or moving or not all(bool(sampler.carved.any()) for sampler in samplers):
        return dataset
    near = [pixels_near(silhouettes, ~s.carved, s.box, s.resolution) for s in samplers]
    return dataset.drawing(PixelSet.shared(near, 1))


def _hull(silhouettes: Silhouettes, sampler: SkipsCells, times: Tensor | None) -> Tensor:
    """Return the cells of `sampler` that `silhouettes`, taken at `times` if it moves, do not show to be empty."""
    if times is None:
        return visual_hull(silhouettes, sampler.box, sampler.resolution)
    return moving_hulls(silhouettes, sampler.box, sampler.resolution, times, sampler.slices)


def _no_silhouettes(dataset: Dataset) -> str | None:
    """Return why the images' alpha cannot show empty space; None if it can."""
    if not dataset.scene.has_alpha:
        return "no photograph has alpha"
    if isinstance(dataset.cameras, NdcCameras):
        return "the box is in normalised device coordinates"
    camera = dataset.cameras.model
    return None if camera == "pinhole" else f"the camera is {camera}, not pinhole"

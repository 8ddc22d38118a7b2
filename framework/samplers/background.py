"""Backgrounds, outside of a scene's box: nothing, a field on the inverted sphere, or the same field, contracted.

The inverted sphere is NeRF++ (Zhang et al. 2020), contraction mip-NeRF 360 (Barron et al. 2022).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal, TypeVar

import torch
from torch import Tensor

from nerfloom.base.config import AUTO, Auto, Range
from nerfloom.base.decisions import Choice, Decision, fill
from nerfloom.base.errors import ConfigError
from nerfloom.data.scene import Scene
from nerfloom.samplers.choice import SamplingConfig, sampler_choice

MARGIN = 1.1
"""Radius of the sphere, in units of the distance of the farthest camera from its centre, as in NeRF++'s own code."""
Model = Literal["none", "sphere", "contraction"]
"""A background that is decided."""


@dataclass(frozen=True)
class BackgroundConfig(SamplingConfig):
    """Settings of a method that can show what is outside of the scene's box."""

    RANGES: ClassVar[dict[str, Range]] = {"num_background_samples": (1, 2**14)}
    """Allowed ranges."""
    background_model: Auto[Literal["none", "sphere", "contraction"]] = AUTO
    """What is outside of the scene's box. none: nothing. sphere: a second field in inverse distance (NeRF++), outside
    of a sphere around the box's centre and all cameras. contraction: the same field, contracted, not with --sampler
    hierarchical. auto: what suits the method if the scene may extend beyond the box, otherwise none."""
    num_background_samples: int = 32
    """Samples per ray outside of the sphere, uniform in inverse distance (sphere). With --sampler hierarchical there
    are as many outside as inside."""


BackgroundConfigT = TypeVar("BackgroundConfigT", bound=BackgroundConfig)


def decide_background(
    config: BackgroundConfigT, scene: Scene, suits: Model = "contraction", bounded: str | None = None
) -> tuple[BackgroundConfigT, list[Decision]]:
    """Decide what is outside of the box, and by which sampler the inside is sampled.

    Args:
        config: the method's settings; those two are filled in if they are left open.
        scene: properties of the scene.
        suits: the background that suits the method if the scene may extend beyond the box. Contraction is left out
            with hierarchical sampling, which follows rays in space as it is.
        bounded: the sampler of what ends; that of `sampler_choice` if None.

    Returns:
        The settings, and the decisions that were made.

    Raises:
        ConfigError: if contraction is asked for with hierarchical sampling, or a sphere in normalised device
            coordinates.
    """
    ends = str(config.sampler) == "hierarchical"
    model, reason = suits, "there may be something outside the box"
    if not scene.unbounded:
        model, reason = "none", "the scene ends at its box"
    elif suits == "contraction" and ends:
        model, reason = "none", "hierarchical samples are not contracted"
    config, made = fill(config, Choice("background_model", model, reason))
    if config.background_model == "contraction" and ends:
        raise ConfigError("--background-model contraction needs --sampler proposal or occupancy")
    if config.background_model == "sphere" and scene.warped:
        raise ConfigError("--background-model sphere: normalised device coordinates have no outside")
    choice = sampler_choice(config, foreground(config, scene).unbounded)
    if config.background_model == "sphere":
        choice = replace(choice, reason="the background shows what is outside")
    if bounded is not None and choice.value != "proposal":
        choice = replace(choice, value=bounded)
    config, more = fill(config, choice)
    return config, made + more


def foreground(config: BackgroundConfig, scene: Scene) -> Scene:
    """Return the scene as the method's own field and sampler see it: without what the background shows.

    Inside of a sphere the box is the cube around the sphere.
    """
    if config.background_model == "sphere":
        sphere = foreground_sphere(scene)
        box = torch.stack([sphere[:3] - sphere[3], sphere[:3] + sphere[3]])
        return replace(scene, box=box, unbounded=False)
    return replace(scene, unbounded=config.background_model == "contraction")


def foreground_sphere(scene: Scene) -> Tensor:
    """Return the sphere (4,), centre and radius, that divides inside and outside.

    It is around the centre of the box, and contains the box's inscribed ellipsoid and, with a margin, all training
    cameras: as in NeRF++, where cameras look out of the sphere and never into it. Without cameras it contains the box.
    """
    centre, half = scene.box.mean(0), (scene.box[1] - scene.box[0]) / 2
    if scene.camera_to_worlds is None:
        return torch.cat([centre, half.norm()[None]])
    farthest = (scene.camera_to_worlds[:, :, 3].to(centre) - centre).norm(dim=-1).amax()
    return torch.cat([centre, torch.maximum(MARGIN * farthest, half.amax())[None]])

"""Backgrounds, outside a scene's box: none, a second field on the inverted sphere, or the same field, contracted.

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
from nerfloom.cameras.poses import looked_at
from nerfloom.data.scene import Scene
from nerfloom.samplers.choice import SamplingConfig, sampler_choice

MARGIN = 1.1
"""Radius of the sphere, relative to the distance of the farthest camera from its centre, as in NeRF++'s own code."""
Model = Literal["none", "sphere", "contraction"]
"""A decided background."""


@dataclass(frozen=True)
class BackgroundConfig(SamplingConfig):
    """Settings of a method that can show the outside of the scene's box."""

    RANGES: ClassVar[dict[str, Range]] = {"num_background_samples": (1, 2**14)}
    background_model: Auto[Literal["none", "sphere", "contraction"]] = AUTO
    """Model of the outside of the scene's box. none: nothing. sphere: a second field in inverse distance (NeRF++),
    outside a sphere (--sphere-around). contraction: the same field, contracted; not with --sampler hierarchical. auto:
    the method's default if the scene may extend beyond the box, otherwise none."""
    sphere_around: Literal["cameras", "object"] = "cameras"
    """Sphere between inside and outside. cameras: around the box's centre and all cameras. object: around the point
    that the cameras look at, up to the nearest camera; the space between a camera and the sphere is not shown."""
    num_background_samples: int = 32
    """Samples per ray outside the sphere, uniform in inverse distance (sphere). With --sampler hierarchical, the
    outside gets the same numbers of samples as the inside."""


BackgroundConfigT = TypeVar("BackgroundConfigT", bound=BackgroundConfig)


def decide_background(
    config: BackgroundConfigT, scene: Scene, suits: Model = "contraction", bounded: str | None = None
) -> tuple[BackgroundConfigT, list[Decision]]:
    """Decide the background, and the sampler for the inside of the box.

    Args:
        config: the method's settings; the background and the sampler are filled in if they are open.
        suits: the method's default background if the scene may extend beyond the box. Contraction is not used with
            hierarchical sampling, which samples rays in uncontracted space.
        bounded: the sampler for bounded scenes; if None, the sampler of `sampler_choice`.

    Returns:
        The settings, and the decisions made.

    Raises:
        ConfigError: if contraction is selected with hierarchical sampling, or a sphere in normalised device
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
        choice = replace(choice, reason="the background shows the outside")
    if bounded is not None and choice.value != "proposal":
        choice = replace(choice, value=bounded)
    config, more = fill(config, choice)
    return config, made + more


def foreground(config: BackgroundConfig, scene: Scene) -> Scene:
    """Return the scene for the method's own field and sampler, without the part that the background shows.

    With a sphere, the box is the cube around the sphere.
    """
    if config.background_model == "sphere":
        sphere = foreground_sphere(config, scene)
        box = torch.stack([sphere[:3] - sphere[3], sphere[:3] + sphere[3]])
        return replace(scene, box=box, unbounded=False)
    return replace(scene, unbounded=config.background_model == "contraction")


def foreground_sphere(config: BackgroundConfig, scene: Scene) -> Tensor:
    """Return the sphere (4,), centre and radius, that separates inside and outside.

    Around the cameras, it is centred on the box. It contains the box's inscribed ellipsoid and, with a margin, all
    training cameras, as in NeRF++: cameras look out of the sphere and never into it. Without cameras it contains the
    box. Around the object, its centre is the point nearest to all cameras' axes, and its radius the distance of the
    nearest camera. If the cameras look at no common point, it is the sphere around the cameras.

    Args:
        scene: properties of the whole scene.
    """
    centre, half = scene.box.mean(0), (scene.box[1] - scene.box[0]) / 2
    if scene.camera_to_worlds is None:
        return torch.cat([centre, half.norm()[None]])
    cameras = scene.camera_to_worlds[:, :, 3].to(centre)
    object_centre = looked_at(scene.camera_to_worlds) if config.sphere_around == "object" else None
    if object_centre is not None:
        centre = object_centre.to(centre)
        return torch.cat([centre, (cameras - centre).norm(dim=-1).amin()[None]])
    farthest = (cameras - centre).norm(dim=-1).amax()
    return torch.cat([centre, torch.maximum(MARGIN * farthest, half.amax())[None]])

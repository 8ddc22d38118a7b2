"""Points on the surfaces of a scene, found by short training of a field; Gaussians can start there."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, cast

import torch
from torch import Tensor

from nerfloom.base.config import TrainConfig
from nerfloom.base.console import track
from nerfloom.data.dataset import Dataset
from nerfloom.export.points import several_passes
from nerfloom.method import Method
from nerfloom.renderable import RefinesPoses, parts, refined_cameras
from nerfloom.training.trainer import Trainer


@dataclass(frozen=True)
class FoundSurfaces:
    """N points on surfaces, and the pixels of training images that show them."""

    positions: Tensor
    """(N, 3) scene coordinates."""
    colors: Tensor
    """(N, 3) colours in [0, 1]."""
    images: Tensor
    """(N,) int64 index of the image that shows the point."""
    pixels: Tensor
    """(N,) int64 index of the pixel in that image, row by row."""
    distances: Tensor
    """(N,) distance from that image's camera, scene units."""
    motions: Tensor | None
    """(M, 6) motions of the training cameras (`PoseRefinement.tangents`) if the field refined their poses, else None.
    Points and distances belong to the moved cameras."""


def found_surfaces(
    method: Method, dataset: Dataset, config: TrainConfig, steps: int, seconds: float, count: int
) -> FoundSurfaces:
    """Train a field for a few steps, and return points on the surfaces that it has found.

    Args:
        method: the method of the field, which casts rays: instant-ngp, or nerfacto where there may be something outside
            the scene's box, which instant-ngp does not see.
        dataset: the images.
        config: settings of the calling run; machine, background and robust are used.
        steps: maximum number of training steps of the field.
        seconds: maximum training time of the field, seconds; infinity for no limit.
        count: maximum number of points.

    Returns:
        The points; fewer than `count`, possibly none, if rays end on no surface.
    """
    # instant-ngp's settings and rates suit a few seconds; nerfacto's do not (docs/notes/splatting.md).
    limit = None if dataset.scene.unbounded or seconds == math.inf else seconds
    usual: Any = method.config
    settings = replace(
        usual,
        max_num_iterations=steps,
        max_seconds=limit,
        machine=config.machine,
        background=config.background,
        robust="errors" if config.robust == "errors" else "off",  # what a scout has found is not drawn any more
    )
    trainer = Trainer(method, settings, dataset)
    for report in track(trainer.steps(), "Looking for surfaces", total=steps):
        if report.seconds >= seconds:
            break
    model = trainer.model.eval()
    refined = [part.poses.tangents.detach() for part in parts(model, RefinesPoses) if part.poses is not None]
    dataset = replace(dataset, cameras=refined_cameras(model, dataset.cameras, training=True))
    found, cameras = several_passes(cast("Any", model), dataset, count), dataset.cameras.to("cpu")
    images = torch.searchsorted(cameras.offsets, found.pixels, right=True) - 1
    distances = (found.positions - cameras.camera_to_worlds[images, :, 3]).norm(dim=-1)
    return FoundSurfaces(
        found.positions.to(dataset.device),
        found.colors.to(dataset.device),
        images.to(dataset.device),
        (found.pixels - cameras.offsets[images]).to(dataset.device),
        distances.to(dataset.device),
        refined[0] if refined else None,
    )

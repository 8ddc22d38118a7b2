"""Points on the surfaces of a scene, found by a short run of a field: where Gaussians may start."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from framework.base.config import TrainConfig
from framework.base.console import track
from framework.data.dataset import Dataset

PASSES = 16
"""Maximum number of times that rays are drawn, of which some end on no surface."""


def found_surfaces(
    dataset: Dataset, config: TrainConfig, steps: int, seconds: float, count: int
) -> tuple[Tensor, Tensor]:
    """Train a field for a few steps, and return points on the surfaces that it has found.

    The field is that of instant-ngp, or that of nerfacto where there may be something outside the scene's box, which
    instant-ngp does not see.

    Args:
        dataset: the images.
        config: settings of the run that asks; machine and background are taken from it.
        steps: maximum number of training steps of the field.
        seconds: maximum time of its training, seconds.
        count: maximum number of points.

    Returns:
        Positions (N, 3) in scene coordinates and colours (N, 3) in [0, 1]; N is less than `count` where rays end on no
        surface, and may be 0.
    """
    from framework.base.registry import load_method
    from framework.export.points import joined, surface_points
    from framework.training.run import Run
    from framework.training.trainer import Trainer

    method = "nerfacto" if dataset.scene.unbounded else "instant-ngp"
    settings = replace(
        load_method(method).config,
        max_num_iterations=steps,
        vis="none",
        machine=config.machine,
        background=config.background,
    )
    trainer = Trainer(Run(method, settings, "", cast("Any", None), Path()), dataset, None)
    for _ in track(range(steps), "Looking for surfaces", total=steps):
        trainer.train_step()
        if trainer.state.seconds >= seconds:
            break
    model = trainer.model.eval()
    points, colors = [torch.zeros(0, 3)], [torch.zeros(0, 3)]
    while (left := count - sum(map(len, points))) > 0 and len(points) < PASSES:
        found = joined(surface_points(cast("Any", model), dataset, 2 * left, None))
        points.append(found.positions[:left])
        colors.append(found.colors[:left])
    return torch.cat(points).to(dataset.device), torch.cat(colors).to(dataset.device)

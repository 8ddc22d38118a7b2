"""Distillation at points: a field learns the density and the colours of a teacher's field, without rays.

KiloNeRF (Reiser et al. 2021), section 3. Densities are compared as opacities of a short length, since they have no
bound, and colours in random directions. The paper draws the same number of points in each cell of its grid. Here most
points are where the teacher has matter, and colours count by its opacity, because transparent points have no colour to
learn.
"""

from __future__ import annotations

import math
import time
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from nerfloom.base.console import say, track
from nerfloom.geometry.points import Points
from nerfloom.kernels.math import safe_normalize
from nerfloom.ray_model import RayModel
from nerfloom.training.optim import make_optimizer
from nerfloom.training.step import backward
from nerfloom.training.teacher import Teacher

POINTS = 2**15
"""Number of points in a step."""
LENGTH_SHARE = 1 / 128
"""Length of the compared opacity, relative to the diagonal of the box. The authors' settings have 0.021 for Lego."""
MIN_WEIGHT = 0.01
"""Weight of the colours where the teacher is transparent; it is 1 where it is opaque."""
CELLS, PROBES = 32, 4
"""Cells along an edge of the box, and positions in each, for finding where the teacher has matter."""
MATTER, MATTER_SHARE = 0.01, 0.75
"""Minimum opacity of matter over the length above, and share of the points that are drawn in cells with matter."""


@runtime_checkable
class TakesTeacher(Protocol):
    """A model that asks a teacher itself, before its first step."""

    def take_teacher(self, teacher: Teacher) -> None:
        """Keep the `teacher` of `--teacher` for `StartsFromImages.start`; this changes no parameters.

        Raises:
            ConfigError: if this teacher cannot be asked.
        """


class MatterPoints:
    """Random points in a box, most of them where a teacher has matter.

    Args:
        teacher: a teacher with a field.
        box: (2, 3) corners of the box, the pupil's scene units.
        length: the length for opacities, the pupil's scene units.
    """

    def __init__(self, teacher: Teacher, box: Tensor, length: float) -> None:
        self.box = box
        found = torch.zeros(CELLS**3, dtype=torch.bool, device=box.device)
        for part in torch.arange(CELLS**3, device=box.device).repeat(PROBES).split(POINTS):
            density, _ = teacher.at_points(self._in(part), random_directions(len(part), box), length)
            found[part[density * length > MATTER]] = True
        self.cells = found.nonzero()[:, 0]
        """(C,) int64 cells with matter, along z first."""

    def draw(self, count: int) -> Tensor:
        """Return `count` random points (count, 3)."""
        there = round(MATTER_SHARE * count) if len(self.cells) else 0
        anywhere = torch.randint(CELLS**3, (count - there,), device=self.box.device)
        if not there:
            return self._in(anywhere)
        chosen = self.cells[torch.randint(len(self.cells), (there,), device=self.box.device)]
        return self._in(torch.cat([chosen, anywhere]))

    def _in(self, cells: Tensor) -> Tensor:
        """Return a random point (N, 3) in each of `cells` (N,)."""
        corners = torch.stack([cells // CELLS**2, cells // CELLS % CELLS, cells % CELLS], dim=-1)
        return torch.lerp(self.box[0], self.box[1], (corners + torch.rand(len(cells), 3, device=cells.device)) / CELLS)


def random_directions(count: int, like: Tensor) -> Tensor:
    """Return `count` unit vectors (count, 3), uniformly distributed, of the device and type of `like`."""
    return safe_normalize(torch.randn(count, 3, dtype=like.dtype, device=like.device))


def point_errors(
    density: Tensor, rgb: Tensor, true_density: Tensor, true_rgb: Tensor, length: float
) -> tuple[Tensor, Tensor]:
    """Return the mean squared errors () of opacities of a `length`, and of colours, at N points.

    `density` and `true_density` are (N,) in 1/scene unit, `rgb` and `true_rgb` (N, 3) in [0, 1].
    """
    opacity, true = (-torch.expm1(-sigma * length) for sigma in (density, true_density))
    weights = true.clamp(min=MIN_WEIGHT)
    return (opacity - true).square().mean(), (weights[:, None] * (rgb - true_rgb).square()).mean()


def distil(model: RayModel[Any], teacher: Teacher, steps: int, seconds: float) -> None:
    """Train the field of a model to be the field of a teacher at points in the scene's box.

    Args:
        model: the pupil; its settings have the learning rate.
        teacher: a teacher with a field.
        steps: maximum number of steps.
        seconds: maximum time; infinity for no limit.

    Raises:
        ConfigError: if the teacher has no field.
    """
    box, begun = model.scene.box.to(model.device), time.perf_counter()
    length = LENGTH_SHARE * float((box[1] - box[0]).norm())
    points, optimizer = MatterPoints(teacher, box, length), make_optimizer(model, model.config)
    model.train()
    done, errors = 0, (math.nan, math.nan)
    for _ in track(range(steps), "Learning the teacher's field", total=steps):
        positions = points.draw(POINTS)
        directions = random_directions(POINTS, box)
        true = teacher.at_points(positions, directions, length)
        with torch.autocast(model.device.type, torch.bfloat16, enabled=model.uses_bfloat16):
            sized = Points(positions, None, torch.full_like(positions[:, 0], length / 2)).sized(length / 12**0.5)
            density, features = model.field.density(sized)
            rgb = model.field.color(features, directions)
        of_opacity, of_color = point_errors(density, rgb, *true, length)
        finite = backward(of_opacity + of_color, optimizer)
        if finite is not False:
            optimizer.step(finite)
        done, errors = done + 1, (float(of_opacity.detach()), float(of_color.detach()))
        if time.perf_counter() - begun >= seconds:
            break
    opacity, color = (math.sqrt(error) for error in errors)
    say(
        f"learnt the teacher's field at points in {done:,} steps, {time.perf_counter() - begun:.0f} s: opacities are "
        f"off by {opacity:.2g}, colours by {color:.2g} (root mean square)"
    )

"""Distillation at points: a field learns the density and the colours of a teacher's field, without a renderer.

KiloNeRF (Reiser et al. 2021), section 3. Densities are compared as opacities of a short length, since they have no
bound. The paper draws the same number of points in each cell of its grid, and random directions. Here most points are
on rays of the training cameras: at the teacher's surface, or in front of it, and in the direction of the ray. No
photograph shows the inside of matter, or a surface from behind, so a teacher has made up its values there. Colours
count by the teacher's opacity, because transparent points have no colour to learn.
"""

from __future__ import annotations

import math
import time
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from nerfloom.base.console import say, track
from nerfloom.base.evenly_spaced import strided
from nerfloom.cameras.view import View
from nerfloom.data.dataset import Dataset
from nerfloom.geometry.bounds import box_around_cells, intersect_box
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
"""Minimum opacity of matter over the length above, and share of the points of `MatterPoints` in cells with matter."""
VIEWS, RAYS = 48, 2**19
"""Maximum number of cameras with rays that points are drawn on, and about the maximum number of these rays."""
LOOKING = 0.2
"""Maximum share of the time for finding where these rays end; a slow teacher shows fewer cameras."""
OPAQUE = 0.5
"""Minimum opacity of a ray with a surface."""
SEEN_SHARE, FRONT_SHARE = 0.85, 0.3
"""Share of the points on rays of cameras, and share of these anywhere in front of the surface. The other points on rays
are at the surface: their distance to it is normally distributed, and its standard deviation is half of the length."""

RATES = 1.0, 0.1
"""Learning rate at the start, relative to the settings', and at the end, relative to the start."""


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

    def around(self) -> Tensor | None:
        """Return the box (2, 3) around the cells with matter, with one more cell on each side; None without matter."""
        inside = torch.zeros(CELLS**3, dtype=torch.bool, device=self.box.device).index_fill_(0, self.cells, True)
        found = box_around_cells(inside.view(CELLS, CELLS, CELLS), self.box, margin=1)
        return None if found is None else found.clamp(self.box[0], self.box[1])

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


def length_in(box: Tensor) -> float:
    """Return the length for opacities in a `box` (2, 3), in the unit of its corners."""
    return LENGTH_SHARE * float((box[1] - box[0]).norm())


class SeenPoints:
    """Random points on rays of the training cameras, up to the surface of a teacher, and the rays' directions.

    Args:
        teacher: a teacher with a field.
        dataset: the training images.
        box: (2, 3) corners of the box that holds the points, the pupil's scene units; None for no box.
        seconds: time after which no further camera is added.
    """

    def __init__(self, teacher: Teacher, dataset: Dataset, box: Tensor | None, seconds: float = math.inf) -> None:
        cameras, scene, begun = dataset.cameras, dataset.scene, time.perf_counter()
        chosen = [strided(len(cameras), VIEWS)[n] for n in torch.randperm(min(len(cameras), VIEWS)).tolist()]
        pixels = int((cameras.widths * cameras.heights)[chosen].sum())
        stride, black = max(math.isqrt(pixels // RAYS), 1), torch.zeros(3, device=cameras.fx.device)
        parts = list[tuple[Tensor, ...]]()
        for index in track(chosen, "Looking at the teacher", total=len(chosen)):
            view = View.of(cameras, index, stride=stride)
            picture = teacher.picture(view, black)
            rays = view.camera.pixel_rays(view.pixels().reshape(-1), scene.near, scene.far)
            opaque, depth = picture.accumulation.reshape(-1) > OPAQUE, picture.median_depth.reshape(-1)
            begin, end = rays.nears, rays.fars
            if box is not None:
                enter, leave = intersect_box(rays.origins, rays.directions, box)
                begin, end = torch.maximum(begin, enter), torch.minimum(end, leave)
            end = torch.where(opaque, torch.minimum(end, depth), end)
            kept = begin < end
            parts.append(tuple(each[kept] for each in (rays.origins, rays.directions, begin, end, opaque)))
            if time.perf_counter() - begun > seconds:
                break
        self.origins, self.directions, self.begins, self.ends, opaque = (
            torch.cat(each) for each in zip(*parts, strict=True)
        )
        """(R, 3) origins and unit directions of the rays, and (R,) distances where points begin and end."""
        self.surfaces = opaque.nonzero()[:, 0]
        """(S,) int64 rays that end at a surface."""

    def draw(self, count: int, length: float) -> tuple[Tensor, Tensor]:
        """Return `count` random points (count, 3), and the directions (count, 3) of their rays.

        Args:
            length: twice the standard deviation of the distance to a surface, the pupil's scene units.
        """
        device, shown = self.ends.device, len(self.surfaces)
        front = round(FRONT_SHARE * count) if shown else count
        at_surface = self.surfaces[torch.randint(max(shown, 1), (count - front,), device=device)]
        rays = torch.cat([at_surface, torch.randint(len(self.ends), (front,), device=device)])
        begins, ends = self.begins[rays], self.ends[rays]
        near = ends[: count - front] + length / 2 * torch.randn(count - front, device=device)
        before = torch.lerp(begins[count - front :], ends[count - front :], torch.rand(front, device=device))
        t = torch.maximum(torch.cat([near, before]), begins)
        return self.origins[rays] + t[:, None] * self.directions[rays], self.directions[rays]

    def toward(self, positions: Tensor) -> Tensor:
        """Return unit directions (N, 3) from random cameras to `positions` (N, 3)."""
        rays = torch.randint(len(self.origins), (len(positions),), device=positions.device)
        return safe_normalize(positions - self.origins[rays])


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


def distil(model: RayModel[Any], teacher: Teacher, dataset: Dataset, box: Tensor, steps: int, seconds: float) -> None:
    """Train the field of a model to be the field of a teacher at points.

    Args:
        model: the pupil; its settings have the learning rate.
        teacher: a teacher with a field.
        dataset: the training images; points are on rays of their cameras.
        box: (2, 3) corners of the box with the points, the pupil's scene units; in an unbounded scene, points on rays
            are outside too.
        steps: maximum number of steps.
        seconds: maximum time; infinity for no limit.

    Raises:
        ConfigError: if the teacher has no field.
    """
    begun, length = time.perf_counter(), length_in(box)
    matter, optimizer = MatterPoints(teacher, box, length), make_optimizer(model, model.config)
    seen = SeenPoints(teacher, dataset, None if model.scene.unbounded else box, LOOKING * seconds)
    on_rays = round(SEEN_SHARE * POINTS) if len(seen.ends) else 0
    model.train()
    done, errors = 0, (math.nan, math.nan)
    for step in track(range(steps), "Learning the teacher's field", total=steps):
        spent = min(max(step / steps, (time.perf_counter() - begun) / max(seconds, 1e-9)), 1.0)
        for group in optimizer.param_groups:
            group["lr"] = group["initial_lr"] * RATES[0] * RATES[1] ** spent
        positions = matter.draw(POINTS - on_rays)
        directions = seen.toward(positions) if on_rays else random_directions(len(positions), box)
        if on_rays:
            drawn = seen.draw(on_rays, length)
            positions, directions = torch.cat([drawn[0], positions]), torch.cat([drawn[1], directions])
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

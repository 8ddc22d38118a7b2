"""Samples with a bounded error of the opacity: VolSDF (Yariv et al. 2021), section 3.3 and algorithm 1.

A signed distance limits how near a surface may come between two samples, and so how much the density can change there.
This bounds the error of an opacity that is computed from samples by the rectangle rule. Samples are added where the
bound is large. If they do not suffice, the density is blurred (a larger beta) until the bound holds.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from nerfloom.base.step_kind import StepKind
from nerfloom.fields.base import Field
from nerfloom.fields.surface import VolSDFField
from nerfloom.geometry.bounds import intersect_box
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.histograms.intervals import resample
from nerfloom.kernels.surfaces.opacity import laplace_density
from nerfloom.samplers.base import Sampler

EPSILON = 0.1
"""Maximum error of the opacity, as in the authors' code."""
ROUNDS = 5
"""Maximum number of times that samples are added, as in the authors' code."""
BISECTIONS = 10
"""Steps of the bisection for the smallest beta that satisfies the bound, as in the authors' code."""
PADDING = 1e-4
"""Added to the weights that samples are drawn from, so that every interval can be drawn."""
MAX_EXPONENT = 60.0
"""Maximum exponent in the error's bound, so that the bound stays finite."""


def nearest_in_intervals(distances: Tensor, lengths: Tensor) -> Tensor:
    """Return the minimum distance to a surface within intervals: VolSDF, theorem 1.

    No surface is nearer than d to a position with the distance d. So balls of these radii around the two ends are
    empty. The bound is the distance from the interval to the nearest position outside both balls.

    Args:
        distances: (R, S) signed distances at S positions along rays.
        lengths: (R, S - 1) lengths between them.

    Returns:
        (R, S - 1) lower bounds of the magnitude of the distance in each interval.
    """
    first, last = distances[:, :-1].abs(), distances[:, 1:].abs()
    half = (lengths + first + last) / 2
    area = half * (half - lengths) * (half - first) * (half - last)  # Heron's formula: squared area of a triangle
    height = 2 * area.clamp(min=0).sqrt() / lengths.clamp(min=torch.finfo(lengths.dtype).tiny)
    beside = (first.square() - last.square()).abs() >= lengths.square()
    nearest = torch.where(beside, torch.minimum(first, last), height)
    return torch.where(first + last <= lengths, torch.zeros_like(nearest), nearest)


class Bounded(NamedTuple):
    """The opacity along R rays at S positions, by the rectangle rule, and its error."""

    opacity: Tensor
    """(R, S) opacity up to each position; 0 at the first."""
    error: Tensor
    """(R, S - 1) bound of the error of the opacity within each interval."""


def bounded_opacity(t: Tensor, distances: Tensor, beta: Tensor) -> Bounded:
    """Return the opacity along rays, and a bound of its error: VolSDF, section 3.3.

    Args:
        t: (R, S) sorted distances along the rays, scene units.
        distances: (R, S) signed distances there. The bound holds if none of them exceeds the true distance to a
            surface.
        beta: (R, 1) or () scale of the Laplace distribution, scene units.
    """
    lengths = t.diff(dim=-1)
    depth = (laplace_density(distances, beta)[:, :-1] * lengths).cumsum(-1)
    nearest = nearest_in_intervals(distances, lengths)
    error = (lengths.square() * torch.exp(-nearest / beta)).cumsum(-1) / (4 * beta.square())
    before = torch.nn.functional.pad(depth, (1, 0))
    left = torch.exp(-before[:, :-1])
    large = torch.exp((error - before[:, :-1]).clamp(max=MAX_EXPONENT)) - left  # expm1 would overflow
    return Bounded(-torch.expm1(-before), torch.where(error < 1, left * torch.expm1(error), large))


def bounding_beta(t: Tensor, distances: Tensor, beta: Tensor, first: Tensor, epsilon: float) -> Tensor:
    """Return the smallest beta of each ray that bounds the opacity's error, found by bisection.

    Args:
        t: (R, S) sorted distances along the rays, scene units.
        distances: (R, S) signed distances there.
        beta: () the density's own beta, the lower limit.
        first: (R, 1) values that make the bound `epsilon` or less.
        epsilon: largest error of the opacity.

    Returns:
        (R, 1) values between `beta` and `first`.
    """
    low = beta.expand_as(first)
    holds = bounded_opacity(t, distances, low).error.amax(-1, keepdim=True) <= epsilon
    high = torch.where(holds, low, torch.maximum(first, low))
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        holds = bounded_opacity(t, distances, middle).error.amax(-1, keepdim=True) <= epsilon
        low, high = torch.where(holds, low, middle), torch.where(holds, middle, high)
    return high


class ErrorBoundedSampler(Sampler):
    """Samples of a field with the density of VolSDF, drawn from an opacity with a bounded error.

    Args:
        box: (2, 3) corners of the box that holds the surfaces, scene units.
        num_steps: number of distances evaluated along a ray at first, and added in each round.
        num_samples: samples per ray.
        epsilon: largest error of the opacity.
    """

    box: Tensor

    def __init__(self, box: Tensor, num_steps: int = 64, num_samples: int = 32, epsilon: float = EPSILON) -> None:
        super().__init__()
        self.num_steps, self.num_samples, self.epsilon = num_steps, num_samples, epsilon
        self.register_buffer("box", box.clone())

    def step_kind(self, step: int) -> StepKind:
        return StepKind(varies="samples are added until a bound holds")

    def sample(self, rays: Rays, field: Field, jitter: bool) -> Samples:
        assert isinstance(field, VolSDFField)
        t, distances, beta = self.bounded(rays.detached(), field, jitter)
        weights = bounded_opacity(t, distances, beta).opacity.diff(dim=-1)
        edges = resample(t, weights, self._shift(t, jitter), self.num_samples, 1.0, PADDING)
        edges[:, 0], edges[:, -1] = t[:, 0], t[:, -1]  # nothing between the ends is left out
        return Samples.regular(edges[:, :-1], edges[:, 1:])

    @torch.no_grad()
    def bounded(self, rays: Rays, field: VolSDFField, jitter: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Evaluate distances along rays until the opacity's error is bounded: VolSDF, algorithm 1.

        Args:
            rays: R rays.
            field: the field.
            jitter: True for random positions, False for fixed ones.

        Returns:
            (R, S) sorted distances along the rays, (R, S) signed distances there, and (R, 1) values of beta, scene
            units, that satisfy the bound.
        """
        enter, leave = intersect_box(rays.origins, rays.directions, self.box)
        nears = torch.maximum(rays.nears, enter)
        fars = torch.maximum(torch.minimum(rays.fars, leave), nears)
        share = torch.linspace(0, 1, self.num_steps + 1, device=nears.device, dtype=nears.dtype)
        t = torch.lerp(nears[:, None], fars[:, None], share)
        distances, beta = self._distances(rays, field, t), 1 / field.sharpness()
        # This value satisfies the bound for any surface, with n intervals of equal or smaller length.
        widest = (fars - nears)[:, None] / (2 * math.sqrt(self.num_steps * math.log1p(self.epsilon)))
        for _ in range(ROUNDS):
            smoothed = bounding_beta(t, distances, beta, widest, self.epsilon)
            if bool((smoothed <= beta).all()):
                return t, distances, smoothed
            errors = bounded_opacity(t, distances, beta).error.clamp(max=1)
            added = resample(t, errors, self._shift(t, jitter), self.num_steps - 1, 1.0, PADDING)
            t, order = torch.cat([t, added], dim=-1).sort(dim=-1)
            distances = torch.cat([distances, self._distances(rays, field, added)], dim=-1).gather(-1, order)
        return t, distances, bounding_beta(t, distances, beta, widest, self.epsilon)

    def _shift(self, t: Tensor, jitter: bool) -> Tensor:
        return torch.rand_like(t[:, 0]) if jitter else torch.full_like(t[:, 0], 0.5)

    @staticmethod
    def _distances(rays: Rays, field: VolSDFField, t: Tensor) -> Tensor:
        """Return the signed distances (R, S) at distances `t` (R, S) along rays."""
        positions = rays.origins[:, None] + rays.directions[:, None] * t[..., None]
        return field.signed_distance(Points(positions.flatten(0, 1))).view_as(t)

"""Scenes whose volume-rendering integral is known: the truth against which samplers are measured.

With tau(t) the integral of density from a ray's near end to the distance t, a pixel is (Max 1995; NeRF, equation 1)

    C = integral of exp(-tau) sigma c dt + exp(-tau(far)) background.

Where density is constant and colour linear this is elementary (`Solids`). Of Gaussians tau is a sum of error functions,
and what is left is the integral of an analytic function, for which Gauss and Legendre's quadrature is exact to rounding
(`Blobs`). All matter lies in `BOX`.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from framework.fields.base import Field
from framework.geometry.bounds import intersect_box
from framework.geometry.points import Points
from framework.geometry.rays import Rays

Triple = tuple[float, float, float]

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
"""(2, 3) smallest and largest corner of the space in which every scene lies."""
PANELS, ORDER = 64, 16
"""Of Gauss and Legendre's quadrature along a ray."""


class Light(NamedTuple):
    """What reaches the eye along R rays, float64."""

    color: Tensor
    """(R, 3) over the background."""
    opacity: Tensor
    """(R,)"""


class ClosedForm(Field):
    """A field whose pixels are known, in any float type. Its features are its colours, alike from all sides."""

    @abstractmethod
    def truth(self, rays: Rays, background: Tensor) -> Light:
        """What R rays see over `background` (3,), between their near and far ends."""

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return features


# -- constant density ---------------------------------------------------------------------------------------------


class Shape(Protocol):
    """A convex part of space."""

    def contains(self, positions: Tensor) -> Tensor:
        """(N,) bool, whether positions (N, 3) lie in it."""

    def crossing(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Distances (R,) at which rays (R, 3) enter and leave it; the same one for a ray that misses."""


@dataclass(frozen=True)
class Ball:
    """All that is nearer to `center` than `radius`."""

    radius: float
    center: Triple = (0.0, 0.0, 0.0)

    def contains(self, positions: Tensor) -> Tensor:
        """As `Shape.contains`."""
        return (positions - positions.new_tensor(self.center)).square().sum(-1) <= self.radius**2

    def crossing(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """As `Shape.crossing`."""
        nearest, squared = _nearest(origins, directions, self.center)
        half = ((self.radius**2 - squared).clamp(min=0) / directions.square().sum(-1)).sqrt()
        return nearest - half, nearest + half


@dataclass(frozen=True)
class Block:
    """The box between two corners, faces included."""

    low: Triple
    high: Triple

    def contains(self, positions: Tensor) -> Tensor:
        """As `Shape.contains`."""
        low, high = positions.new_tensor(self.low), positions.new_tensor(self.high)
        return ((positions >= low) & (positions <= high)).all(-1)

    def crossing(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """As `Shape.crossing`."""
        return intersect_box(origins, directions, origins.new_tensor((self.low, self.high)))


@dataclass(frozen=True)
class Medium:
    """Matter of constant density and linear colour."""

    shape: Shape
    density: float
    """1/length."""
    color: Triple = (0.0, 0.0, 0.0)
    """At the origin."""
    slope: Triple = (0.0, 0.0, 0.0)
    """By how much red grows along x, green along y, blue along z, 1/length."""

    def colors(self, positions: Tensor) -> Tensor:
        """(N, 3) at positions (N, 3)."""
        return positions.new_tensor(self.color) + positions.new_tensor(self.slope) * positions


class Solids(ClosedForm):
    """Media of constant density. Where several lie, the last one named is there alone, so that they can be nested.

    Args:
        media: the outer ones before the inner ones.
    """

    def __init__(self, *media: Medium) -> None:
        super().__init__()
        self.media = media

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        positions = points.positions
        sigma, color = positions.new_zeros(len(positions)), torch.zeros_like(positions)
        for medium in self.media:
            inside = medium.shape.contains(positions)
            sigma = sigma.masked_fill(inside, medium.density)
            color = torch.where(inside[:, None], medium.colors(positions), color)
        return sigma, color

    def truth(self, rays: Rays, background: Tensor) -> Light:
        """Added up over the stretches between surfaces, each of which is one medium's."""
        origins, directions, nears, fars = _double(rays)
        crossings = [t for medium in self.media for t in medium.shape.crossing(origins, directions)]
        ends = torch.stack([nears, fars, *crossings], dim=-1)
        ends = ends.clamp(nears[:, None], fars[:, None]).sort(dim=-1).values
        starts, lengths = ends[:, :-1], ends.diff(dim=-1)
        sigma, _ = self._along(origins, directions, starts + lengths / 2)
        tau = sigma * lengths
        # Of a linear colour, what a stretch sends out is the colour at the mean place where its light is stopped.
        _, color = self._along(origins, directions, starts + lengths * mean_place(tau))
        weights = torch.exp(-(tau.cumsum(-1) - tau)) * -torch.expm1(-tau)
        spent = tau.sum(-1)
        return _over(background, (weights[..., None] * color).sum(1), spent)

    def _along(self, origins: Tensor, directions: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Density (R, B) and colour (R, B, 3) at distances t (R, B)."""
        sigma, color = self.density(Points(_points(origins, directions, t)))
        return sigma.view(t.shape), color.view(*t.shape, 3)


def mean_place(tau: Tensor) -> Tensor:
    """The mean place, from 0 at its start to 1, at which a homogeneous stretch of optical depth tau stops light.

    1 / tau - 1 / (exp(tau) - 1), which is 1/2 where the stretch is thin.
    """
    thin = tau < 1e-2
    safe = torch.where(thin, torch.ones_like(tau), tau)
    return torch.where(thin, 0.5 - tau / 12 + tau**3 / 720, 1 / safe - 1 / torch.expm1(safe))


# -- Gaussians ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Gaussian:
    """Matter whose density falls as a Gaussian, alike in all directions."""

    center: Triple
    deviation: float
    """Length at which density is exp(-1/2) of its peak."""
    peak: float
    """1/length."""
    color: Triple

    def density(self, positions: Tensor) -> Tensor:
        """(N,) at positions (N, 3)."""
        squared = (positions - positions.new_tensor(self.center)).square().sum(-1)
        return self.peak * torch.exp(-squared / (2 * self.deviation**2))

    def optical_depth(self, origins: Tensor, directions: Tensor, starts: Tensor, t: Tensor) -> Tensor:
        """(R, B) between distances starts (R,) and t (R, B) along rays (R, 3)."""
        nearest, squared = _nearest(origins, directions, self.center)
        width = self.deviation * math.sqrt(2) / directions.norm(dim=-1)
        whole = self.peak * torch.exp(-squared / (2 * self.deviation**2)) * width * math.sqrt(math.pi) / 2
        before, after = ((end - nearest[:, None]) / width[:, None] for end in (starts[:, None], t))
        return whole[:, None] * (torch.erf(after) - torch.erf(before))


class Blobs(ClosedForm):
    """Gaussians that lie in one another: densities add up, and each sends out its own colour."""

    def __init__(self, *gaussians: Gaussian) -> None:
        super().__init__()
        self.gaussians = gaussians

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        positions = points.positions
        sigma, color = positions.new_zeros(len(positions)), torch.zeros_like(positions)
        for gaussian in self.gaussians:
            own = gaussian.density(positions)
            sigma = sigma + own
            color = color + own[:, None] * positions.new_tensor(gaussian.color)
        return sigma, color / sigma.clamp(min=torch.finfo(sigma.dtype).tiny)[:, None]

    def truth(self, rays: Rays, background: Tensor) -> Light:
        """Opacity in closed form; colour by quadrature of an integrand whose optical depth is in closed form."""
        origins, directions, nears, fars = _double(rays)
        nodes, shares = (torch.from_numpy(v).to(nears) for v in gauss_legendre(PANELS, ORDER))
        t = torch.lerp(nears[:, None], fars[:, None], nodes)
        sigma, color = self.density(Points(_points(origins, directions, t)))
        in_front = self.optical_depth(rays, t)
        weights = torch.exp(-in_front) * sigma.view(t.shape) * shares * (fars - nears)[:, None]
        spent = self.optical_depth(rays, fars[:, None])[:, 0]
        return _over(background, (weights[..., None] * color.view(*t.shape, 3)).sum(1), spent)

    def optical_depth(self, rays: Rays, t: Tensor) -> Tensor:
        """(R, B) float64, from the rays' near ends to distances t (R, B)."""
        origins, directions, nears, _ = _double(rays)
        parts = [g.optical_depth(origins, directions, nears, t) for g in self.gaussians]
        return torch.stack(parts).sum(0)


def gauss_legendre(panels: int, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights, (panels * order,) each, that integrate over [0, 1] in equal panels."""
    nodes, weights = np.polynomial.legendre.leggauss(order)
    within = (nodes + 1) / 2
    return ((np.arange(panels)[:, None] + within) / panels).ravel(), np.tile(weights / 2 / panels, panels)


# -- rays ---------------------------------------------------------------------------------------------------------


def _double(rays: Rays) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Origins, directions, near and far ends in float64."""
    return rays.origins.double(), rays.directions.double(), rays.nears.double(), rays.fars.double()


def _points(origins: Tensor, directions: Tensor, t: Tensor) -> Tensor:
    """(R * B, 3) at distances t (R, B)."""
    return (origins[:, None] + t[..., None] * directions[:, None]).view(-1, 3)


def _nearest(origins: Tensor, directions: Tensor, center: Triple) -> tuple[Tensor, Tensor]:
    """The distance (R,) at which rays come nearest to a point, and the square of how near that is."""
    to_center = origins.new_tensor(center) - origins
    nearest = (to_center * directions).sum(-1) / directions.square().sum(-1)
    return nearest, (nearest[:, None] * directions - to_center).square().sum(-1)


def _over(background: Tensor, color: Tensor, spent: Tensor) -> Light:
    """Light (R, 3) that matter sends out along rays of optical depth `spent` (R,), over what is behind."""
    return Light(color + torch.exp(-spent)[:, None] * background.double(), -torch.expm1(-spent))


# -- scenes -------------------------------------------------------------------------------------------------------


def scenes() -> dict[str, ClosedForm]:
    """Every scene by its name, each hard in its own way."""
    corners = product((-0.5, 0.5), repeat=3)
    return {
        # Thin and everywhere: nothing can be skipped.
        "fog": Solids(Medium(Block((-0.8, -0.7, -0.6), (0.8, 0.7, 0.6)), 0.6, (0.5, 0.5, 0.5), (0.5, 0.5, 0.5))),
        # Jumps of density and colour.
        "nested": Solids(
            Medium(Ball(0.75), 1.5, (0.2, 0.4, 0.8), (0.2, 0.2, 0.2)),
            Medium(Ball(0.35, (0.1, 0.0, 0.05)), 20.0, (0.8, 0.5, 0.1)),
        ),
        # Smooth.
        "blobs": Blobs(
            Gaussian((0.0, 0.0, 0.0), 0.10, 18.0, (0.9, 0.2, 0.1)),
            Gaussian((0.25, 0.1, -0.1), 0.08, 25.0, (0.1, 0.7, 0.3)),
            Gaussian((-0.2, 0.25, 0.1), 0.10, 12.0, (0.2, 0.3, 0.9)),
            Gaussian((-0.1, -0.3, -0.2), 0.09, 20.0, (0.9, 0.8, 0.2)),
            Gaussian((0.2, -0.15, 0.3), 0.07, 30.0, (0.5, 0.1, 0.6)),
        ),
        # A surface: even steps pass over it.
        "shell": Solids(Medium(Ball(0.7), 200.0, (0.5, 0.5, 0.5), (0.6, 0.6, 0.6)), Medium(Ball(0.68), 0.0)),
        # Mostly empty: what skipping is for.
        "sparse": Solids(
            *(Medium(Ball(0.1, (x, y, z)), 60.0, (0.5, 0.5, 0.5), (0.7, 0.7, 0.7)) for x, y, z in corners)
        ),
    }

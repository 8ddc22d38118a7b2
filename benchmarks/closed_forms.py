"""Scenes with a known volume-rendering integral, for measuring the errors of samplers.

With tau(t) the integral of density from a ray's near end to the distance t, a pixel is (Max 1995; NeRF, equation 1)

    C = integral of exp(-tau) sigma c dt + exp(-tau(far)) background.

For constant density and linear colour this is elementary (`Solids`). For Gaussians, tau is a sum of error functions and
the integrand is analytic, so Gauss-Legendre quadrature is exact up to rounding (`Blobs`). All matter is in
`BOX`.
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

from nerfloom.fields.base import Field
from nerfloom.geometry.bounds import intersect_box
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays

Triple = tuple[float, float, float]
"""A position, a direction or a colour."""

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
"""(2, 3) minimum and maximum corner of the box that contains every scene."""
PANELS, ORDER = 64, 16
"""Number of panels of Gauss-Legendre quadrature along a ray, and nodes per panel."""


class Light(NamedTuple):
    """Colours and opacities of R rays, float64."""

    color: Tensor
    """(R, 3) colours over the background."""
    opacity: Tensor
    """(R,) opacities, 0 to 1."""


class ClosedForm(Field):
    """A field with known rendered colours, in any float type; its features are its colours."""

    @abstractmethod
    def truth(self, rays: Rays, background: Tensor) -> Light:
        """Compute colours and opacities of R `rays` over a `background` (3,), between their near and far ends."""

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return features


# -- constant density ---------------------------------------------------------------------------------------------


class Shape(Protocol):
    """A convex part of space."""

    def contains(self, positions: Tensor) -> Tensor:
        """Return whether `positions` (N, 3) are inside, (N,) bool; the boundary is inside."""

    def crossing(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Return distances (R,) where rays, `origins` and `directions` (R, 3), enter and leave; equal if they miss."""


@dataclass(frozen=True)
class Ball:
    """The ball of a `radius` around a `center`."""

    radius: float
    center: Triple = (0.0, 0.0, 0.0)

    def contains(self, positions: Tensor) -> Tensor:
        """Return whether `positions` (N, 3) are inside, as `Shape.contains`."""
        return (positions - positions.new_tensor(self.center)).square().sum(-1) <= self.radius**2

    def crossing(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Intersect rays of `origins` and `directions` (R, 3), as `Shape.crossing`."""
        nearest, squared = _nearest(origins, directions, self.center)
        half = ((self.radius**2 - squared).clamp(min=0) / directions.square().sum(-1)).sqrt()
        return nearest - half, nearest + half


@dataclass(frozen=True)
class Block:
    """The box between the corners `low` and `high`, faces included."""

    low: Triple
    high: Triple

    def contains(self, positions: Tensor) -> Tensor:
        """Return whether `positions` (N, 3) are inside, as `Shape.contains`."""
        low, high = positions.new_tensor(self.low), positions.new_tensor(self.high)
        return ((positions >= low) & (positions <= high)).all(-1)

    def crossing(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Intersect rays of `origins` and `directions` (R, 3), as `Shape.crossing`."""
        return intersect_box(origins, directions, origins.new_tensor((self.low, self.high)))


@dataclass(frozen=True)
class Medium:
    """Matter of constant density and linear colour."""

    shape: Shape
    """Region of the matter."""
    density: float
    """Density, 1/length."""
    color: Triple = (0.0, 0.0, 0.0)
    """Colour at the origin."""
    slope: Triple = (0.0, 0.0, 0.0)
    """Derivatives of red along x, green along y and blue along z, 1/length."""

    def colors(self, positions: Tensor) -> Tensor:
        """Return colours (N, 3) at `positions` (N, 3)."""
        return positions.new_tensor(self.color) + positions.new_tensor(self.slope) * positions


class Solids(ClosedForm):
    """Media of constant density, outer ones before inner ones: where several overlap, only the last one counts."""

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
        """Sum over the intervals between surfaces, each in one medium."""
        origins, directions, nears, fars = _double(rays)
        crossings = [t for medium in self.media for t in medium.shape.crossing(origins, directions)]
        ends = torch.stack([nears, fars, *crossings], dim=-1)
        ends = ends.clamp(nears[:, None], fars[:, None]).sort(dim=-1).values
        starts, lengths = ends[:, :-1], ends.diff(dim=-1)
        sigma, _ = self._along(origins, directions, starts + lengths / 2)
        tau = sigma * lengths
        # An interval of linear colour emits the colour at the mean position where light is stopped.
        _, color = self._along(origins, directions, starts + lengths * mean_place(tau))
        weights = torch.exp(-(tau.cumsum(-1) - tau)) * -torch.expm1(-tau)
        depth = tau.sum(-1)
        return _over(background, (weights[..., None] * color).sum(1), depth)

    def _along(self, origins: Tensor, directions: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Return density (R, B) and colour (R, B, 3) at distances t (R, B)."""
        sigma, color = self.density(Points(_points(origins, directions, t)))
        return sigma.view(t.shape), color.view(*t.shape, 3)


def mean_place(tau: Tensor) -> Tensor:
    """Return the mean position, 0 to 1, where a homogeneous interval of optical depth `tau` stops light.

    It is 1 / tau - 1 / (exp(tau) - 1), and tends to 1/2 for small tau.
    """
    thin = tau < 1e-2
    safe = torch.where(thin, torch.ones_like(tau), tau)
    return torch.where(thin, 0.5 - tau / 12 + tau**3 / 720, 1 / safe - 1 / torch.expm1(safe))


# -- Gaussians ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Gaussian:
    """Matter with an isotropic Gaussian as density."""

    center: Triple
    """Position of the peak."""
    deviation: float
    """Standard deviation, length."""
    peak: float
    """Density at the centre, 1/length."""
    color: Triple
    """Colour, the same everywhere."""

    def density(self, positions: Tensor) -> Tensor:
        """Return density (N,), 1/length, at `positions` (N, 3)."""
        squared = (positions - positions.new_tensor(self.center)).square().sum(-1)
        return self.peak * torch.exp(-squared / (2 * self.deviation**2))

    def optical_depth(self, origins: Tensor, directions: Tensor, starts: Tensor, t: Tensor) -> Tensor:
        """Return the optical depth (R, B) of rays, `origins` and `directions` (R, 3), from `starts` (R,) to `t`."""
        nearest, squared = _nearest(origins, directions, self.center)
        width = self.deviation * math.sqrt(2) / directions.norm(dim=-1)
        whole = self.peak * torch.exp(-squared / (2 * self.deviation**2)) * width * math.sqrt(math.pi) / 2
        before, after = ((end - nearest[:, None]) / width[:, None] for end in (starts[:, None], t))
        return whole[:, None] * (torch.erf(after) - torch.erf(before))


class Blobs(ClosedForm):
    """Overlapping Gaussians with densities that add up; each emits its own colour."""

    def __init__(self, *gaussians: Gaussian) -> None:
        super().__init__()
        self.gaussians = gaussians

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        positions = points.positions
        sigma, color = positions.new_zeros(len(positions)), torch.zeros_like(positions)
        for gaussian in self.gaussians:
            density = gaussian.density(positions)
            sigma = sigma + density
            color = color + density[:, None] * positions.new_tensor(gaussian.color)
        return sigma, color / sigma.clamp(min=torch.finfo(sigma.dtype).tiny)[:, None]

    def truth(self, rays: Rays, background: Tensor) -> Light:
        """Compute opacity in closed form, and colour by quadrature with optical depths in closed form."""
        origins, directions, nears, fars = _double(rays)
        nodes, shares = (torch.from_numpy(v).to(nears) for v in gauss_legendre(PANELS, ORDER))
        t = torch.lerp(nears[:, None], fars[:, None], nodes)
        sigma, color = self.density(Points(_points(origins, directions, t)))
        in_front = self.optical_depth(rays, t)
        weights = torch.exp(-in_front) * sigma.view(t.shape) * shares * (fars - nears)[:, None]
        depth = self.optical_depth(rays, fars[:, None])[:, 0]
        return _over(background, (weights[..., None] * color.view(*t.shape, 3)).sum(1), depth)

    def optical_depth(self, rays: Rays, t: Tensor) -> Tensor:
        """Return the optical depth (R, B) float64 of `rays` from their near ends to distances `t` (R, B)."""
        origins, directions, nears, _ = _double(rays)
        parts = [g.optical_depth(origins, directions, nears, t) for g in self.gaussians]
        return torch.stack(parts).sum(0)


def gauss_legendre(panels: int, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights of quadrature over [0, 1] in equal `panels` of `order` nodes, (panels * order,) each."""
    nodes, weights = np.polynomial.legendre.leggauss(order)
    within = (nodes + 1) / 2
    return ((np.arange(panels)[:, None] + within) / panels).ravel(), np.tile(weights / 2 / panels, panels)


# -- rays ---------------------------------------------------------------------------------------------------------


def _double(rays: Rays) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return origins, directions, near and far ends in float64."""
    return rays.origins.double(), rays.directions.double(), rays.nears.double(), rays.fars.double()


def _points(origins: Tensor, directions: Tensor, t: Tensor) -> Tensor:
    """Return positions (R * B, 3) at distances t (R, B)."""
    return (origins[:, None] + t[..., None] * directions[:, None]).view(-1, 3)


def _nearest(origins: Tensor, directions: Tensor, center: Triple) -> tuple[Tensor, Tensor]:
    """Return the distance (R,) along rays to the point nearest to `center`, and its squared distance from it (R,)."""
    to_center = origins.new_tensor(center) - origins
    nearest = (to_center * directions).sum(-1) / directions.square().sum(-1)
    return nearest, (nearest[:, None] * directions - to_center).square().sum(-1)


def _over(background: Tensor, color: Tensor, depth: Tensor) -> Light:
    """Return emitted colours (R, 3) of rays of optical depth (R,), composited over the background."""
    return Light(color + torch.exp(-depth)[:, None] * background.double(), -torch.expm1(-depth))


# -- scenes -------------------------------------------------------------------------------------------------------


def scenes() -> dict[str, ClosedForm]:
    """Return all scenes by name."""
    corners = product((-0.5, 0.5), repeat=3)
    return {
        # Thin everywhere: no sample can be skipped.
        "fog": Solids(Medium(Block((-0.8, -0.7, -0.6), (0.8, 0.7, 0.6)), 0.6, (0.5, 0.5, 0.5), (0.5, 0.5, 0.5))),
        # Discontinuous density and colour.
        "nested": Solids(
            Medium(Ball(0.75), 1.5, (0.2, 0.4, 0.8), (0.2, 0.2, 0.2)),
            Medium(Ball(0.35, (0.1, 0.0, 0.05)), 20.0, (0.8, 0.5, 0.1)),
        ),
        # Smooth density.
        "blobs": Blobs(
            Gaussian((0.0, 0.0, 0.0), 0.10, 18.0, (0.9, 0.2, 0.1)),
            Gaussian((0.25, 0.1, -0.1), 0.08, 25.0, (0.1, 0.7, 0.3)),
            Gaussian((-0.2, 0.25, 0.1), 0.10, 12.0, (0.2, 0.3, 0.9)),
            Gaussian((-0.1, -0.3, -0.2), 0.09, 20.0, (0.9, 0.8, 0.2)),
            Gaussian((0.2, -0.15, 0.3), 0.07, 30.0, (0.5, 0.1, 0.6)),
        ),
        # A thin surface, which evenly spaced samples may miss.
        "shell": Solids(Medium(Ball(0.7), 200.0, (0.5, 0.5, 0.5), (0.6, 0.6, 0.6)), Medium(Ball(0.68), 0.0)),
        # Mostly empty, so that skipping saves most.
        "sparse": Solids(
            *(Medium(Ball(0.1, (x, y, z)), 60.0, (0.5, 0.5, 0.5), (0.7, 0.7, 0.7)) for x, y, z in corners)
        ),
    }

"""Gaussians in space: the parameters of a splatted scene, as they are optimised and as files hold them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from nerfloom.cameras.view import View
from nerfloom.kernels.splats.project import DEGREES
from nerfloom.rendering.rendered import Picture
from nerfloom.splats.look import Look

MAX_DEGREE = max(DEGREES)
"""Highest degree of the spherical harmonics that colours are made of."""


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians of 3D Gaussian Splatting (Kerbl et al. 2023), before their activations."""

    means: Tensor
    """(N, 3) centres, scene coordinates; float64 if a file holds them so."""
    log_scales: Tensor
    """(N, 3) logarithm of the standard deviation along each axis."""
    rotations: Tensor
    """(N, 4) quaternions w, x, y, z from the axes to the scene, of any length but 0."""
    logits: Tensor
    """(N,) opacity before the sigmoid."""
    colors: Tensor
    """(N, 3) coefficients of the harmonic of degree 0 for red, green and blue: the part of a colour that is the same
    from everywhere is 0.5 + DC * colors."""
    harmonics: Tensor
    """(N, 3, K) coefficients of degrees 1 to D for each channel, in the order of `spherical_harmonics`; K is 0, 3, 8
    or 15."""

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def degree(self) -> int:
        """Highest degree of the harmonics, 0 to 3."""
        return {count: degree for degree, count in DEGREES.items()}[self.harmonics.shape[2]]

    @property
    def typical_size(self) -> float:
        """Median of the standard deviations; 0 without Gaussians."""
        return float(self.log_scales.exp().median()) if len(self) else 0.0

    def map(self, function: Callable[[Tensor], Tensor]) -> Gaussians:
        """Return what a function makes of every tensor.

        Args:
            function: is applied to each of the six.
        """
        return Gaussians(**{field.name: function(getattr(self, field.name)) for field in fields(self)})

    def __getitem__(self, index: Tensor | slice) -> Gaussians:
        """Return the Gaussians selected by a slice, a mask or an index tensor."""
        return self.map(lambda values: values[index])

    def finite(self) -> Tensor:
        """Return (N,) whether all parameters of a Gaussian are finite."""
        values = (getattr(self, field.name) for field in fields(self))
        return torch.stack([each.flatten(1).isfinite().all(1) for each in (v.unsqueeze(-1) for v in values)]).all(0)


class Splats(NamedTuple):
    """Gaussians as a file holds them."""

    gaussians: Gaussians
    """The Gaussians."""
    look: Look
    """How they are drawn."""


@runtime_checkable
class HasGaussians(Protocol):
    """A model that consists of Gaussians."""

    def gaussians(self) -> Gaussians:
        """Return them, without gradient."""

    def look(self) -> Look:
        """Return how they are drawn."""


@runtime_checkable
class RendersGaussians(HasGaussians, Protocol):
    """A model that renders some of its Gaussians as well as all."""

    def render_gaussians(self, gaussians: Gaussians, view: View, background: Tensor) -> Picture:
        """Render given Gaussians, such as some of its own, as `Model.render_view` does all of them.

        Args:
            gaussians: what is drawn, in the frame of the scene.
            view, background: as in `Model.render_view`.
        """

"""Gaussians in space: the parameters of a splatted scene."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from nerfloom.cameras.view import View
from nerfloom.kernels.splats.project import DEGREES
from nerfloom.rendering.rendered import Picture
from nerfloom.splats.look import Look

MAX_DEGREE = max(DEGREES)
"""Highest degree of the spherical harmonics of colours."""
MAX_TESTED = 2**18
"""Maximum number of Gaussians that are tested at a time."""
COLUMNS = ("means", "log_scales", "rotations", "logits", "colors", "harmonics")
"""Names of the columns that all Gaussians have."""


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians of 3D Gaussian Splatting (Kerbl et al. 2023), before their activations.

    The parameters are named columns: six for drawing, and any that a method adds.
    """

    means: Tensor
    """(N, 3) centres, scene coordinates; float64 if the file stores doubles."""
    log_scales: Tensor
    """(N, 3) logarithm of the standard deviation along each axis."""
    rotations: Tensor
    """(N, 4) quaternions w, x, y, z from the axes to the scene, of any non-zero length."""
    logits: Tensor
    """(N,) opacity before the sigmoid."""
    colors: Tensor
    """(N, 3) coefficients of degree 0 for red, green and blue. 0.5 + DC * colors is the part of the colour that does
    not depend on the view."""
    harmonics: Tensor
    """(N, 3, K) coefficients of degrees 1 to D for each channel, in the order of `spherical_harmonics`; K is 0, 3, 8
    or 15."""
    extras: Mapping[str, Tensor] = field(default_factory=dict)
    """Further columns (N, ...) by name, such as velocities. They are not written to files."""

    @classmethod
    def of(cls, columns: Mapping[str, Tensor]) -> Gaussians:
        """Return Gaussians of columns.

        Args:
            columns: the six, and any others, by name.
        """
        extras = {name: values for name, values in columns.items() if name not in COLUMNS}
        return cls(**{name: columns[name] for name in COLUMNS}, extras=extras)

    @classmethod
    def joined(cls, parts: Sequence[Gaussians]) -> Gaussians:
        """Concatenate Gaussians.

        Args:
            parts: at least one, all with the same columns.
        """
        columns = [part.columns for part in parts]
        return cls.of({name: torch.cat([each[name] for each in columns]) for name in columns[0]})

    @property
    def columns(self) -> dict[str, Tensor]:
        """All parameters by name: the six, then the others."""
        return {name: getattr(self, name) for name in COLUMNS} | dict(self.extras)

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
        """Apply a function to every column.

        Args:
            function: the function.
        """
        return Gaussians.of({name: function(values) for name, values in self.columns.items()})

    def __getitem__(self, index: Tensor | slice) -> Gaussians:
        """Return the Gaussians selected by a slice, a mask or an index tensor."""
        return self.map(lambda values: values[index])

    def finite(self) -> Tensor:
        """Return (N,) whether all parameters of a Gaussian are finite."""
        found = torch.ones(len(self), dtype=torch.bool, device=self.means.device)
        for values in self.columns.values():
            for first in range(0, len(self), MAX_TESTED):  # a test of all harmonics at once would take much memory
                part = values[first : first + MAX_TESTED].unsqueeze(-1).flatten(1)
                found[first : first + MAX_TESTED] &= part.isfinite().all(1)
        return found

    def drawable(self) -> Tensor:
        """Return (N,) whether a Gaussian can be drawn: finite, with finite sizes and a rotation that is not zero."""
        lengths = self.rotations.norm(dim=-1)
        return self.finite() & self.log_scales.exp().isfinite().all(-1) & lengths.isfinite() & (lengths > 0)

    def sliced(self, most: int) -> Iterator[Gaussians]:
        """Yield the Gaussians in their order, in slices of at most `most`."""
        for first in range(0, len(self), most):
            yield self[first : first + most]


class Splats(NamedTuple):
    """Gaussians and their settings of drawing, as stored in a file."""

    gaussians: Gaussians
    """The Gaussians."""
    look: Look
    """The settings of drawing."""


@runtime_checkable
class HasGaussians(Protocol):
    """A model that consists of Gaussians."""

    def gaussians(self, time: float | None = None) -> Gaussians:
        """Return the Gaussians at a time, without gradient.

        Args:
            time: in [0, 1]; None for a still scene.
        """

    def look(self) -> Look:
        """Return the settings of drawing."""


@runtime_checkable
class HasGaussianParts(HasGaussians, Protocol):
    """A model with Gaussians in several parts, not all of them in memory."""

    def gaussian_parts(self, time: float | None = None) -> Iterator[Gaussians]:
        """Yield the Gaussians of `HasGaussians.gaussians` part by part, on the CPU. Degrees of harmonics may differ.

        Args:
            time: in [0, 1]; None for a still scene.
        """


@runtime_checkable
class RendersGaussians(HasGaussians, Protocol):
    """A model that can render a part of its Gaussians."""

    def render_gaussians(self, gaussians: Gaussians, view: View, background: Tensor) -> Picture:
        """Render the given Gaussians, such as a part of the model's.

        Args:
            gaussians: Gaussians in the frame of the scene.
            view, background: as in `Model.render_view`.
        """

"""Fields of a signed distance: NeuS (Wang et al. 2021) and VolSDF (Yariv et al. 2021)."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor, nn

from nerfloom.base.device import HostValue
from nerfloom.base.optimised import Optimised
from nerfloom.fields.appearance import Appearance
from nerfloom.fields.base import MLP, Field
from nerfloom.fields.directional import Light, Reflection
from nerfloom.fields.distance import Distance, Shape
from nerfloom.geometry.points import Points
from nerfloom.kernels.encodings.frequency import frequency_encoding
from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics
from nerfloom.kernels.surfaces.opacity import laplace_density
from nerfloom.kernels.surfaces.samples import PLACED, Intervals, unit_normals
from nerfloom.kernels.surfaces.signed_distance import stepped

DIRECTION_LEVELS = 4
"""Bands of the spherical harmonics of viewing directions."""


class Sharpness(nn.Module):
    """The learnt inverse width of a surface: NeuS, exp(10 v).

    Args:
        first: value at the start, 1/length.
        rate: learning rate of v.
    """

    SPEED = 10.0

    def __init__(self, first: float, rate: float) -> None:
        super().__init__()
        self.first = first
        self.exponent = nn.Parameter(torch.tensor(math.log(first) / self.SPEED))
        self.optimised = Optimised("sharpness", rate)

    def forward(self) -> Tensor:
        """Return the inverse width (), 1/length."""
        return torch.exp(self.SPEED * self.exponent)

    @torch.no_grad()
    def limit(self, factor: float) -> None:
        """Keep the inverse width between the first value and a multiple of it.

        Args:
            factor: the multiple; infinity for no upper bound.
        """
        least = math.log(self.first)
        self.exponent.clamp_(least / self.SPEED, (least + math.log(factor)) / self.SPEED)


class AnnealedSharpness(Sharpness):
    """The inverse width of a surface, and the progress of the annealing of its slope (`surface_opacity`).

    Args:
        first, rate: as in `Sharpness`.
    """

    annealing: Tensor

    def __init__(self, first: float, rate: float) -> None:
        super().__init__(first, rate)
        self.register_buffer("annealing", torch.tensor(0.0))
        self._share = HostValue()

    @property
    def share(self) -> float:
        """Fraction of the annealing that is done, from 0 to 1."""
        return self._share.of(self.annealing)

    def anneal(self, share: float) -> None:
        """Set the fraction of the annealing that is done.

        Args:
            share: fraction from 0 to 1 that float32 represents exactly.
        """
        self._share.change(self.annealing, share)


class SurfaceField(Field):
    """A field of a signed distance, and a colour that depends on position, normal, direction and features.

    Args:
        box: (2, 3) corners of the box, scene units.
        distance: the distance, and features for the colour.
        sharpness: the learnt inverse width of the surface.
        width: features of a hidden layer of the colour network.
        color_layers: hidden layers of the colour network.
        color_bias: whether its layers have biases.
        direction_frequencies: number of frequencies of the encoded viewing direction; None for spherical harmonics.
        appearance: the images' appearance vectors, an input of the colour network; None without.
        reflection: colours by the reflected direction; they use the distance's normals, and its features as properties
            of the surface. None for a colour network of position, normal and viewing direction.
    """

    box: Tensor

    def __init__(
        self,
        box: Tensor,
        distance: Distance,
        sharpness: Sharpness,
        width: int = 64,
        color_layers: int = 1,
        color_bias: bool = False,
        direction_frequencies: int | None = None,
        appearance: Appearance | None = None,
        reflection: Reflection | None = None,
    ) -> None:
        super().__init__()
        self.register_buffer("box", box.clone(memory_format=torch.contiguous_format))
        self.distance, self.sharpness, self.appearance = distance, sharpness, appearance
        self.size, self.direction_frequencies = distance.size, direction_frequencies
        self.runs_on_kernels = distance.runs_on_kernels
        self.reflection = reflection
        self.color_head: MLP | None = None
        if reflection is None:
            directions = DIRECTION_LEVELS**2 if direction_frequencies is None else 3 + 6 * direction_frequencies
            inputs = PLACED + distance.num_features + directions + (0 if appearance is None else appearance.size)
            self.color_head = MLP(inputs, *[width] * color_layers, 3, bias=color_bias, activation="sigmoid")
        self.cell = 0.0
        """Diagonal of the sampler's cells, scene units: the maximum distance between two positions in a cell."""
        self.progress = 0.0
        """Fraction of the training budget that is spent."""

    def shape(self, positions: Tensor) -> Shape:
        """Return distance, gradient and features at positions.

        Args:
            positions: (N, 3) scene coordinates.
        """
        shape: Shape = self.distance(positions)
        return shape

    def reach(self, safety: float) -> Callable[[Tensor], Tensor]:
        """Return a function from positions (N, 3) to lengths (N,) that rays may step from there (`stepped`).

        Args:
            safety: maximum slope of the distance along a step, relative to its slope at the position.
        """

        def bound(positions: Tensor) -> Tensor:
            shape = self.shape(positions)
            return stepped(shape.distances, shape.gradients, safety)

        return bound

    def signed_distance(self, points: Points) -> Tensor:
        """Return the distances (N,) from `points` to the nearest surface, scene units, negative inside."""
        return self.distance.values(points.positions)

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        if self.color_head is None:
            return self.light(features, directions, camera_indices).rgb
        if self.direction_frequencies is None:
            encoded = spherical_harmonics(directions, DIRECTION_LEVELS)
        else:
            encoded = frequency_encoding(directions, self.direction_frequencies)
        inputs = [unit_normals(features), encoded]
        if self.appearance is not None:
            inputs.append(self.appearance(camera_indices, len(features)))
        return self.color_head(*inputs).float()

    def light(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Light:
        """Return the light of points, as `HasLight` does; an appearance changes the reflected light alone.

        `features`, `directions` and `camera_indices` are as there; the field has a `Reflection`.
        """
        assert self.reflection is not None
        vectors = () if self.appearance is None else (self.appearance(camera_indices, len(features)),)
        rows = unit_normals(features)
        found: Light = self.reflection(rows[:, PLACED:], rows[:, :3], directions, *vectors)
        return found

    @abstractmethod
    def density_at(self, distances: Tensor) -> Tensor:
        """Return the density (N,), 1/length.

        Args:
            distances: (N,) signed distances, scene units.
        """

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        shape = self.shape(points.positions)
        placed = (points.positions - self.distance.centre) / self.size
        return self.density_at(shape.distances), torch.cat([shape.gradients, placed, shape.features], dim=-1)

    def density_around(self, points: Points) -> tuple[Tensor, Tensor]:
        """Return a bound of the density (N,) within `cell` of each point, and no features, (N, 0).

        The inside counts as occupied: a surface that retreats during training must find its cells.
        """
        distances = self.distance.values(points.positions)
        return self.density_at(distances - self.cell), distances.new_zeros(len(points), 0)


class NeuSField(SurfaceField):
    """A field with the opacity of NeuS, equation 13, for intervals; its sharpness is an `AnnealedSharpness`."""

    sharpness: AnnealedSharpness

    def alpha(self, points: Points, directions: Tensor, deltas: Tensor) -> tuple[Tensor, Tensor]:
        """Return the opacity of intervals around `points`, by `directions` and `deltas`, as `HasAlpha` does."""
        intervals = Intervals(directions, deltas, self.sharpness.share)
        return self.distance.samples(points.positions, self.sharpness(), intervals)

    def density_at(self, distances: Tensor) -> Tensor:
        """Return the density of a ray that meets the surface head-on: NeuS, equation 10."""
        sharpness = self.sharpness()
        return sharpness * torch.sigmoid(-sharpness * distances)


class VolSDFField(SurfaceField):
    """A field with the density of VolSDF, equation 2; the inverse width is 1 / beta."""

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        return self.distance.samples(points.positions, self.sharpness())

    def density_at(self, distances: Tensor) -> Tensor:
        return laplace_density(distances, 1 / self.sharpness())

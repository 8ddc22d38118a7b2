"""Fields of a signed distance: NeuS (Wang et al. 2021) and VolSDF (Yariv et al. 2021), on a hash grid."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from nerfloom.base.device import HostValue
from nerfloom.base.optimised import Optimised
from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.fields.appearance import Appearance
from nerfloom.fields.base import MLP
from nerfloom.fields.encoded import BoxField
from nerfloom.geometry.points import Points
from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics
from nerfloom.kernels.grids.hash_grid_lookup import TableGradient
from nerfloom.kernels.grids.hash_grid_tangent import LOOK_UP
from nerfloom.kernels.surfaces.distance import distance_network
from nerfloom.kernels.surfaces.opacity import laplace_density
from nerfloom.kernels.surfaces.samples import PLACED, Ball, Intervals, ball_distance, surface_samples, unit_normals

ROUNDING = 1e-3
"""Radius around the first ball's centre within which its distance is smoothed, in radii of the ball."""
FIRST_WEIGHTS = 1e-2
"""Size of the first weights of the distance's output; the field starts as a ball with a little noise."""
DIRECTION_LEVELS = 4
"""Bands of the spherical harmonics of viewing directions."""


class Shape(NamedTuple):
    """Values of a field at N positions."""

    distances: Tensor
    """(N,) signed distance, scene units, negative inside."""
    gradients: Tensor
    """(N, 3) gradient of the distance."""
    features: Tensor
    """(N, F) features of the network."""


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


class SurfaceField(BoxField):
    """A field of a signed distance, and a colour that depends on position, normal, direction and features.

    The distance is that of a ball plus the output of a small network on a hash grid, in units of the box.

    Args:
        box: (2, 3) corners of the box, scene units.
        encoding: encoding of positions in [0, 1]^3.
        sharpness: the learnt inverse width of the surface.
        radius: radius of the first ball, as a fraction of half of the box's shortest edge.
        width: features of a hidden layer.
        num_features: number of features for the colour.
        appearance: the images' appearance vectors, an input of the colour network; None if there are none.
    """

    centre: Tensor

    def __init__(
        self,
        box: Tensor,
        encoding: HashGrid,
        sharpness: Sharpness,
        radius: float = 0.5,
        width: int = 64,
        num_features: int = 15,
        appearance: Appearance | None = None,
    ) -> None:
        super().__init__(box, encoding)
        self.sharpness = sharpness
        if encoding.deferred is not None:  # gradients of this table are those of features and of their derivatives
            encoding.deferred = TableGradient(LOOK_UP, encoding.layout)
        self.size = float((box[1] - box[0]).min()) / 2
        self.radius, self.num_features, self.appearance = radius * self.size, num_features, appearance
        self.register_buffer("centre", box.mean(0), persistent=False)
        self.first = nn.Parameter(torch.empty(width, encoding.num_features))
        self.second = nn.Parameter(torch.empty(1 + num_features, width))
        nn.init.kaiming_uniform_(self.first, nonlinearity="relu")
        nn.init.kaiming_uniform_(self.second, nonlinearity="relu")
        with torch.no_grad():
            self.second[0].mul_(FIRST_WEIGHTS)
        inputs = PLACED + num_features + DIRECTION_LEVELS**2 + (0 if appearance is None else appearance.size)
        self.color_head = MLP(inputs, width, width, 3, bias=False, activation="sigmoid")
        self.cell = 0.0
        """Diagonal of the sampler's cells, scene units: the maximum distance between two positions in a cell."""
        self.progress = 0.0
        """Fraction of the training budget that is spent."""

    @property
    def grid(self) -> HashGrid:
        """The hash grid."""
        assert isinstance(self.encoding, HashGrid)
        return self.encoding

    @property
    def ball(self) -> Ball:
        """The distance that the network's output is added to."""
        return Ball(self.centre, self.scale, self.size, self.radius, ROUNDING * self.radius)

    def network(self, positions: Tensor) -> Tensor:
        """Return the network's outputs, and the gradient of the first by the position in the box (`distance_network`).

        Args:
            positions: (N, 3) scene coordinates.
        """
        found, grid = self.unit(positions), self.grid
        first: Tensor = self.first
        layout, opening = grid.layout, grid.opening
        table: Tensor = grid.table
        if opening is not None and not opening.complete:
            layout = layout.first(opening.count)
            open_features = layout.num_levels * table.shape[1]
            factors = opening.completed(first.new_ones(1, open_features), grid.num_features)
            table, first = table[: layout.num_entries], (first * factors)[:, :open_features]
        if grid.deferred is not None:
            grid.deferred.layout = layout
        return distance_network(found, table, first, self.second, layout, grid.deferred)

    def shape(self, positions: Tensor) -> Shape:
        """Return distance, gradient and features at positions.

        Args:
            positions: (N, 3) scene coordinates.
        """
        network = self.network(positions)
        return Shape(*ball_distance(network, positions, self.ball), network[:, 1:-3])

    def reach(self, safety: float) -> Callable[[Tensor], Tensor]:
        """Return a function from positions (N, 3) to lengths (N,) that rays may step from there, negative inside.

        Args:
            safety: maximum slope of the distance along a step, relative to its slope at the position.
        """

        def bound(positions: Tensor) -> Tensor:
            shape = self.shape(positions)
            return shape.distances / (safety * shape.gradients.norm(dim=-1).clamp(min=1))

        return bound

    def signed_distance(self, points: Points) -> Tensor:
        """Return the distances (N,) from `points` to the nearest surface, scene units, negative inside."""
        return self.shape(points.positions).distances

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        inputs = [unit_normals(features), spherical_harmonics(directions, DIRECTION_LEVELS)]
        if self.appearance is not None:
            inputs.append(self.appearance(camera_indices, len(features)))
        return self.color_head(*inputs).float()

    @abstractmethod
    def density_at(self, distances: Tensor) -> Tensor:
        """Return the density (N,), 1/length.

        Args:
            distances: (N,) signed distances, scene units.
        """

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        shape = self.shape(points.positions)
        placed = (points.positions - self.centre) / self.size
        return self.density_at(shape.distances), torch.cat([shape.gradients, placed, shape.features], dim=-1)

    def density_around(self, points: Points) -> tuple[Tensor, Tensor]:
        """Return a bound of the density (N,) within `cell` of each point, and the network's features.

        The inside counts as occupied: a surface that retreats during training must find its cells.

        Args:
            points: N points.
        """
        shape = self.shape(points.positions)
        return self.density_at(shape.distances - self.cell), shape.features


class NeuSField(SurfaceField):
    """A field whose intervals have the opacity of NeuS, equation 13; its sharpness is an `AnnealedSharpness`."""

    sharpness: AnnealedSharpness

    def alpha(self, points: Points, directions: Tensor, deltas: Tensor) -> tuple[Tensor, Tensor]:
        """Return the opacity of intervals around points, and features.

        Args:
            points: N points, in the middle of their intervals.
            directions: (N, 3) unit directions of their rays.
            deltas: (N,) lengths of the intervals, scene units.
        """
        positions, intervals = points.positions, Intervals(directions, deltas, self.sharpness.share)
        return surface_samples(self.network(positions), self.sharpness(), positions, self.ball, intervals)

    def density_at(self, distances: Tensor) -> Tensor:
        """Return the density of a ray that meets the surface head-on: NeuS, equation 10."""
        sharpness = self.sharpness()
        return sharpness * torch.sigmoid(-sharpness * distances)


class VolSDFField(SurfaceField):
    """A field with the density of VolSDF, equation 2; the inverse width is 1 / beta."""

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        return surface_samples(self.network(points.positions), self.sharpness(), points.positions, self.ball)

    def density_at(self, distances: Tensor) -> Tensor:
        return laplace_density(distances, 1 / self.sharpness())

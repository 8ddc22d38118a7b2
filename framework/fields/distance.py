"""Learnt signed distances: a shape plus a small network on a hash grid, and the network of IDR, NeuS and VolSDF."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import pad, softplus

from nerfloom.base.errors import ConfigError
from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.kernels.argument_checks import is_followed
from nerfloom.kernels.encodings.frequency import frequency_encoding_reference
from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout
from nerfloom.kernels.grids.hash_grid_lookup import TableGradient
from nerfloom.kernels.grids.hash_grid_tangent import LOOK_UP
from nerfloom.kernels.surfaces.distance import distance_network, following_positions
from nerfloom.kernels.surfaces.samples import (
    NO_FLOOR,
    FirstShape,
    Intervals,
    first_distance,
    stopped_samples,
    surface_samples,
)
from nerfloom.kernels.surfaces.signed_distance import SignedDistance, signed_distances
from nerfloom.kernels.table_memory import require

ROUNDING = 1e-3
"""Radius of the rounding at the centre of the first ball, where a distance has no gradient; in radii of the ball."""
FIRST_WEIGHTS = 1e-2
"""Size of the first weights of the distance's output; the field starts as a ball with a little noise."""
SHARP = 100.0
"""Sharpness beta of softplus between the layers of the large network, as in the authors' code."""
FITTED, RIDGE = 2_048, 1e-4
"""Number of places where the large network is fitted to the first ball, and the weight of changes of its parameters."""
NUM_FEATURES, DEPTH = 15, 8
"""Number of features that the small network has for the colour, and of hidden layers of the large network."""
AT_ONCE = 2**14
"""Number of positions evaluated at once without gradients of parameters: their hidden layers must fit into memory."""


class Shape(NamedTuple):
    """Values of a distance at N positions."""

    distances: Tensor
    """(N,) signed distance, scene units, negative inside."""
    gradients: Tensor
    """(N, 3) gradient of the distance."""
    features: Tensor
    """(N, F) features for the colour."""


class Distance(nn.Module, ABC):
    """Base class of learnt signed distances.

    Args:
        box: (2, 3) corners of the box, scene units.
        num_features: number F of features for the colour.
    """

    centre: Tensor
    runs_on_kernels: ClassVar[bool] = False
    """True if compiled kernels do most of the work; torch's own operations then use one CPU thread."""

    def __init__(self, box: Tensor, num_features: int) -> None:
        super().__init__()
        self.register_buffer("centre", box.mean(0), persistent=False)
        self.size, self.num_features = float((box[1] - box[0]).min()) / 2, num_features

    @abstractmethod
    def forward(self, positions: Tensor) -> Shape:
        """Return distance, gradient and features at positions.

        Args:
            positions: (N, 3) scene coordinates.
        """

    def values(self, positions: Tensor) -> Tensor:
        """Return the signed distances (N,) at positions, without the work for their gradient if none is recorded.

        Args:
            positions: (N, 3) scene coordinates.
        """
        shape: Shape = self(positions)
        return shape.distances

    def known(self) -> SignedDistance | None:
        """Return the distance in the form for compiled calls; None if it has no such form."""
        return None

    def samples(
        self, positions: Tensor, sharpness: Tensor, intervals: Intervals | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return the density or opacity of samples, and the inputs of their colour (`surface_samples`).

        Args:
            positions: (N, 3) scene coordinates of the samples.
            sharpness: () inverse width of the surface, 1/length.
            intervals: the intervals around the samples; None for points.
        """
        placed = (positions - self.centre) / self.size
        shape: Shape = self(positions)
        return stopped_samples(shape.distances, shape.gradients, shape.features, placed, sharpness, intervals)


class GridDistance(Distance):
    """The distance of a ball or a floor plus the output of a small network on a hash grid, in units of the box.

    Args:
        box: (2, 3) corners of the box, scene units.
        grid: encoding of positions in [0, 1]^3.
        radius: radius of the first ball, as a fraction of half of the box's shortest edge.
        width: features of the hidden layer.
    """

    scale: Tensor
    shift: Tensor
    floor: Tensor
    runs_on_kernels = True

    def __init__(self, box: Tensor, grid: HashGrid, radius: float, width: int) -> None:
        super().__init__(box, NUM_FEATURES)
        edges = box[1] - box[0]
        self.register_buffer("scale", 1 / edges, persistent=False)
        self.register_buffer("shift", -box[0] / edges, persistent=False)
        self.register_buffer("floor", torch.tensor(NO_FLOOR))
        if grid.deferred is not None:  # gradients of this table come from features and from their derivatives
            grid.deferred = TableGradient(LOOK_UP, grid.layout)
        self.grid, self.radius = grid, radius * self.size
        self.first = nn.Parameter(torch.empty(width, grid.num_features))
        self.second = nn.Parameter(torch.empty(1 + NUM_FEATURES, width))
        nn.init.kaiming_uniform_(self.first, nonlinearity="relu")
        nn.init.kaiming_uniform_(self.second, nonlinearity="relu")
        with torch.no_grad():
            self.second[0].mul_(FIRST_WEIGHTS)

    @property
    def first_shape(self) -> FirstShape:
        """The distance that the network's output is added to."""
        return FirstShape(self.centre, self.scale, self.size, self.radius, ROUNDING * self.radius, self.floor)

    def stand_on(self, normal: Tensor, point: Tensor) -> None:
        """Add a floor to the first shape.

        Args:
            normal: (3,) unit vector, upwards.
            point: (3,) scene coordinates of a point on the floor.
        """
        self.floor.copy_(torch.cat([normal, (normal * point).sum()[None]]))

    def network(self, positions: Tensor) -> Tensor:
        """Return the network's outputs, and the gradient of the first by the position in the box (`distance_network`).

        Args:
            positions: (N, 3) scene coordinates. If they require a gradient, the outputs have it, and the gradient of
                the first counts as constant.
        """
        unit, grid = torch.addcmul(self.shift, positions, self.scale), self.grid
        table, first, layout = self._open()
        if grid.deferred is not None:
            grid.deferred.layout = layout
        found = distance_network(unit.detach(), table, first, self.second, layout, grid.deferred)
        return found + following_positions(unit, table, first, self.second, layout) if is_followed(unit) else found

    def _open(self) -> tuple[Tensor, Tensor, HashGridLayout]:
        """Return table, weights of the hidden layer and layout of the levels that are open."""
        table, first, layout, opening = self.grid.table, self.first, self.grid.layout, self.grid.opening
        if opening is None or opening.complete:
            return table, first, layout
        layout = layout.first(opening.count)
        open_features = layout.num_levels * table.shape[1]
        factors = opening.completed(first.new_ones(1, open_features), self.grid.num_features)
        return table[: layout.num_entries], (first * factors)[:, :open_features].contiguous(), layout

    def known(self) -> SignedDistance:
        table, first, layout = self._open()
        return SignedDistance(self.shift, table, layout, first, self.second, self.first_shape)

    def values(self, positions: Tensor) -> Tensor:
        if torch.is_grad_enabled():
            return super().values(positions)
        return signed_distances(positions, self.known())

    def forward(self, positions: Tensor) -> Shape:
        network = self.network(positions)
        return Shape(*first_distance(network, positions, self.first_shape), network[:, 1:-3])

    def samples(
        self, positions: Tensor, sharpness: Tensor, intervals: Intervals | None = None
    ) -> tuple[Tensor, Tensor]:
        return surface_samples(self.network(positions), sharpness, positions, self.first_shape, intervals)


class NetworkDistance(Distance):
    """The network of IDR (Yariv et al. 2020), NeuS and VolSDF: softplus, a skip connection, and a ball to start from.

    The first weights are those of SAL (Atzmon and Lipman 2020), which make a network of endless width the distance of a
    ball. One of 256 features is off by a seventh of the radius, differently in each direction. So the weights of the
    output are then fitted to the ball by least squares. Halfway through the hidden layers, the encoded position is
    concatenated again.

    Args:
        box: (2, 3) corners of the box, scene units.
        radius: radius of the first ball, as a fraction of half of the box's shortest edge.
        width: features of a hidden layer, and for the colour.
        num_frequencies: number of frequencies of the encoded positions.

    Raises:
        ConfigError: if the hidden layers are not wider than the encoded position.
    """

    def __init__(self, box: Tensor, radius: float = 0.5, width: int = 256, num_frequencies: int = 6) -> None:
        super().__init__(box, width)
        self.skip, self.num_frequencies = DEPTH // 2, num_frequencies
        inputs = 3 + 6 * num_frequencies
        if width <= inputs:
            raise ConfigError(
                f"--hidden-width is {width}; it must be more than the {inputs} features of an encoded position "
                "(--position-frequencies)"
            )
        require(4.0 * (DEPTH + 1) * width**2, "a network")
        widths = [width] * DEPTH
        widths[self.skip - 1] -= inputs  # which are concatenated
        self.hidden = nn.ModuleList(
            nn.Linear(before, after) for before, after in zip([inputs, *[width] * (DEPTH - 1)], widths, strict=True)
        )
        self.output = nn.Linear(width, 1 + width)
        self._start(inputs, radius)

    @torch.no_grad()
    def _start(self, inputs: int, radius: float) -> None:
        """Set the first weights."""
        for index, layer in enumerate(self.hidden):
            assert isinstance(layer, nn.Linear)
            nn.init.normal_(layer.weight, 0.0, math.sqrt(2 / layer.out_features))
            nn.init.zeros_(layer.bias)
            waves = inputs - 3  # features of the encoded position that are not the position itself
            if waves and index in (0, self.skip):
                layer.weight[:, -waves:] = 0
        nn.init.zeros_(self.output.bias)
        self.output.weight[0] = math.sqrt(math.pi / self.output.in_features)
        self.output.bias[0] = -radius
        places = 2 * torch.rand(FITTED, 3) - 1
        hidden = pad(self._hidden(places), (0, 1), value=1.0).double()
        now = torch.cat([self.output.weight[0], self.output.bias[:1]]).double()
        off = places.double().norm(dim=-1) - radius - hidden @ now
        normal = hidden.T @ hidden / FITTED + RIDGE * torch.eye(len(now), dtype=torch.float64)
        fitted = (now + torch.linalg.solve(normal, hidden.T @ off / FITTED)).float()
        self.output.weight[0], self.output.bias[0] = fitted[:-1], fitted[-1]

    def _hidden(self, places: Tensor) -> Tensor:
        """Return the features (N, W) of the last hidden layer at places (N, 3) relative to the box."""
        encoded = frequency_encoding_reference(places, self.num_frequencies)  # which has second derivatives
        found = encoded
        for index, layer in enumerate(self.hidden):
            if index == self.skip:
                found = torch.cat([found, encoded], dim=-1) / math.sqrt(2)
            found = softplus(layer(found), SHARP)
        return found

    def forward(self, positions: Tensor) -> Shape:
        if torch.is_grad_enabled():
            return self._shape(positions, learns=True)
        parts = [self._shape(part, learns=False) for part in positions.split(AT_ONCE)]
        return parts[0] if len(parts) == 1 else Shape(*(torch.cat(column) for column in zip(*parts, strict=True)))

    def _shape(self, positions: Tensor, learns: bool) -> Shape:
        """Return the shape at positions, with gradients of the parameters if the network `learns`."""
        # Not in bfloat16, which has too few digits for distances near the surface.
        with torch.enable_grad(), torch.autocast(positions.device.type, enabled=False):
            places = (positions.to(self.output.weight.dtype) - self.centre) / self.size
            places = places if places.requires_grad else places.requires_grad_()
            outputs = self.output(self._hidden(places))
            (gradients,) = torch.autograd.grad(outputs[:, 0].sum(), places, create_graph=learns)
        shape = Shape(self.size * outputs[:, 0], gradients, outputs[:, 1:])
        return shape if learns else Shape(*(values.detach() for values in shape))

"""A field of many small networks, one for each cell of a grid: KiloNeRF (Reiser et al. 2021), section 3."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor, nn

from nerfloom.base.errors import ConfigError, shown
from nerfloom.base.optimised import Optimised
from nerfloom.fields.base import Field
from nerfloom.geometry.bounds import to_unit_box
from nerfloom.geometry.points import Points
from nerfloom.kernels.adam.row_gradient import RowGradient, table_rows
from nerfloom.kernels.encodings.contraction import contract_to_unit
from nerfloom.kernels.encodings.frequency import frequency_encoding
from nerfloom.kernels.networks.grouped import grouped_density_mlp, grouped_mlp, layers_of, parameter_count
from nerfloom.kernels.networks.mlp import MAX_LAYERS, MAX_WIDTH, Activation
from nerfloom.kernels.table_memory import require, table


class GroupedMLP(nn.Module):
    """Many fully connected networks of the same shape, with ReLU between their layers.

    All networks start with the same weights, as in the authors' code. The parameters of a network are a row of a table,
    and the optimiser updates only the networks that a step used.

    Args:
        count: number of networks.
        widths: number of features of the input, of each hidden layer, and of the output.
        activation: activation function of the output.

    Raises:
        ConfigError: if a width is less than 1, or the weights need more memory than the machine has.
    """

    optimised = Optimised(sparse=True)

    def __init__(self, count: int, *widths: int, activation: Activation = "none") -> None:
        if min(widths) < 1:
            raise ConfigError(f"each layer of a network needs 1 feature or more, not {shown(min(widths))}")
        require(4.0 * count * parameter_count(widths), "the networks of a grid")
        super().__init__()
        self.widths, self.activation = widths, activation
        self.table = nn.Parameter(table(count, parameter_count(widths)).copy_(_initial(widths)))
        self.deferred: RowGradient | None = RowGradient()

    def forward(self, owners: Tensor, *inputs: Tensor) -> Tensor:
        """Return the outputs (N, D_out) of rows.

        Args:
            owners: (N,) int64 network of each row.
            inputs: parts (N, D_i) that are concatenated along their features.
        """
        return grouped_mlp(inputs, owners, self.table, self.widths, self.activation, self.deferred)

    def density(self, owners: Tensor, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return densities (N,) and features (N, D_out) of rows, as `grouped_density_mlp` does.

        The networks must have no activation function at their output.

        Args:
            owners: (N,) int64 network of each row.
            inputs: parts (N, D_i) that are concatenated along their features.
        """
        return grouped_density_mlp(inputs, owners, self.table, self.widths, self.deferred)

    def length(self, owners: Tensor) -> Tensor:
        """Return the sum () of the Euclidean norms of each layer's weights and biases, over networks that have rows.

        Args:
            owners: (N,) int64 network of each row; the number of its rows does not matter.
        """
        used = torch.bincount(owners, minlength=len(self.table)).nonzero()[:, 0]
        weights, biases = layers_of(table_rows(self.table, used, self.deferred), self.widths)
        return torch.stack([values.norm() for values in (*weights, *biases)]).sum()


def _initial(widths: tuple[int, ...]) -> Tensor:
    """Return random parameters (P,) of a network, in the order of `layers_of`."""
    parts: list[Tensor] = []
    sizes = list(pairwise(widths))
    for layer, (inputs, outputs) in enumerate(sizes):
        weight, bias = torch.empty(outputs, inputs), torch.empty(outputs)
        gain = 3.0 if layer == len(sizes) - 1 else 6.0  # He et al. 2015: twice as much where a ReLU follows
        nn.init.uniform_(weight, -math.sqrt(gain / inputs), math.sqrt(gain / inputs))
        nn.init.uniform_(bias, -math.sqrt(1 / inputs), math.sqrt(1 / inputs))
        parts += [weight.flatten(), bias]
    return torch.cat(parts)


class NetworkGrid(Field):
    """A field with one small network for each cell of a grid; each network encodes positions in its cell.

    The viewing direction enters before the last hidden layer, so that the layers before it compute the density.

    Args:
        box: (2, 3) corners of the box, scene units.
        resolution: number of cells along the longest edge of the box; the cells are about cubes.
        width: features of a hidden layer (32 in the paper).
        depth: hidden layers before density and features (2 in the paper).
        position_frequencies: number L of frequencies of the encoded positions (10 in the paper).
        direction_frequencies: number L of frequencies of the encoded directions (4 in the paper).
        unbounded: whether the grid covers all of space, contracted by `contract_to_unit`.
    """

    box: Tensor
    counts: Tensor

    def __init__(
        self,
        box: Tensor,
        resolution: int = 16,
        width: int = 32,
        depth: int = 2,
        position_frequencies: int = 10,
        direction_frequencies: int = 4,
        unbounded: bool = False,
    ) -> None:
        super().__init__()
        self.unbounded = unbounded
        self.position_frequencies, self.direction_frequencies = position_frequencies, direction_frequencies
        self.cells = (resolution,) * 3 if unbounded else cells_along(box, resolution)
        self.register_buffer("box", box.clone(memory_format=torch.contiguous_format))
        self.register_buffer("counts", torch.tensor(self.cells, dtype=torch.float32), persistent=False)
        count = self.cells[0] * self.cells[1] * self.cells[2]
        self.trunk = GroupedMLP(count, 3 + 6 * position_frequencies, *[width] * depth, 1 + width)
        self.color_head = GroupedMLP(count, width + 3 + 6 * direction_frequencies, width, 3, activation="sigmoid")
        widths = *self.trunk.widths, *self.color_head.widths
        self.runs_on_kernels = depth < MAX_LAYERS and max(widths) <= MAX_WIDTH

    def move_to(self, box: Tensor) -> None:
        """Move the grid of cells to another `box` (2, 3); the number of cells along each axis stays the same."""
        self.box.copy_(box)

    def located(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Return the cell (N,) int64 of each position, and its place (N, 3) in the cell, in [-1, 1].

        A position outside of the box belongs to the nearest cell, and its place is outside of [-1, 1].

        Args:
            positions: (N, 3) scene coordinates.
        """
        unit = contract_to_unit(positions, self.box) if self.unbounded else to_unit_box(positions, self.box)
        scaled = unit * self.counts
        corner = torch.minimum(scaled.detach().floor().clamp(min=0), self.counts - 1)
        x, y, z = corner.nan_to_num(0.0).long().unbind(-1)  # the place of a position that is NaN stays NaN
        return (x * self.cells[1] + y) * self.cells[2] + z, 2 * (scaled - corner) - 1

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        owners, places = self.located(points.positions)
        encoded = frequency_encoding(places, self.position_frequencies)
        return self.trunk.density(owners, encoded)

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        encoded = frequency_encoding(directions, self.direction_frequencies)
        return self.color_head(self.owners(features), features[:, 1:], encoded).float()

    def owners(self, features: Tensor) -> Tensor:
        """Return the cell (N,) int64 of each row of `features` (N, F) from `density`."""
        return features[:, 0].detach().long()


def cells_along(box: Tensor, resolution: int) -> tuple[int, int, int]:
    """Return the number of cells along each axis of a box, such that they are about cubes.

    Args:
        box: (2, 3) corners of the box, scene units.
        resolution: number of cells along the longest edge.
    """
    x, y, z = (box[1] - box[0]).tolist()
    longest = max(x, y, z)
    along_x, along_y, along_z = (max(round(resolution * edge / longest), 1) for edge in (x, y, z))
    return along_x, along_y, along_z

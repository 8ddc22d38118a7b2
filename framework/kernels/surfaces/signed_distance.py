"""A signed distance, a first shape plus the first output of a small network, in the form for compiled calls.

    f(x) = g(x) + b y_0(u),     u = shift + scale x

`samples.py` has the first shape g, and `distance.py` the network y on a hash grid. Updates of an occupancy grid and
searches along rays need no gradient of f. `signed_distances` leaves it out, with half of the look-ups and products.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from nerfloom.kernels import native
from nerfloom.kernels.dispatch import CPP, FEW_OPERATIONS, Operation
from nerfloom.kernels.grids.hash_grid import hash_grid, hash_grid_reference
from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout
from nerfloom.kernels.surfaces.distance import distance_network
from nerfloom.kernels.surfaces.samples import FirstShape, first_distance, shape_distance


class SignedDistance(NamedTuple):
    """A first shape plus the first output of a network with one hidden layer, with ReLU, on a hash grid."""

    shift: Tensor
    """(3,) added to scaled positions, so that the box becomes the unit box."""
    table: Tensor
    """(E, F) entries of all levels."""
    layout: HashGridLayout
    """Resolutions and offsets of the levels."""
    first: Tensor
    """(H, L * F) weights of the hidden layer."""
    second: Tensor
    """(D, H) weights of the output."""
    shape: FirstShape
    """The first shape, with scale and unit of the network."""

    def unit(self, positions: Tensor) -> Tensor:
        """Return `positions` (N, 3), scene coordinates, in the unit box."""
        return torch.addcmul(self.shift, positions, self.shape.scale)

    def with_gradients(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Return the distances (N,) at `positions` (N, 3), scene coordinates, and their gradients (N, 3)."""
        network = distance_network(self.unit(positions), self.table, self.first, self.second, self.layout)
        return first_distance(network, positions, self.shape)

    def reach(self, positions: Tensor, safety: float) -> Tensor:
        """Return the lengths (N,) that rays may step from `positions` (N, 3), by the factor `safety` (`stepped`)."""
        return stepped(*self.with_gradients(positions), safety)


def stepped(distances: Tensor, gradients: Tensor, safety: float) -> Tensor:
    """Return the lengths (N,) that rays may step from positions with these distances, negative inside.

    A step does not pass a surface if, along the step, the distance changes at most `safety` times as fast as its
    gradient at the start says, or as a gradient of length 1 says if that is longer.

    Args:
        distances: (N,) signed distances.
        gradients: (N, 3) their gradients.
        safety: the factor.
    """
    return distances / (safety * gradients.norm(dim=-1).clamp(min=1))


def signed_distances(positions: Tensor, known: SignedDistance) -> Tensor:
    """Return the distances (N,) at positions, negative inside. The compiled form has no gradient.

    Args:
        positions: (N, 3) scene coordinates.
        known: the distance.
    """
    return SIGNED_DISTANCES((positions, known.table, known.first, known.second), positions, known)


def signed_distances_reference(positions: Tensor, known: SignedDistance) -> Tensor:
    """Compute `signed_distances` of `positions` and `known` in PyTorch, for any device and float type."""
    return _around_shape(hash_grid_reference(known.unit(positions), known.table, known.layout), positions, known)


def _around_shape(encoded: Tensor, positions: Tensor, known: SignedDistance) -> Tensor:
    """Return the distances (N,) from features of the grid, not in bfloat16, which has no digits near a surface."""
    with torch.autocast(positions.device.type, enabled=False):
        output = torch.relu(encoded @ known.first.t()) @ known.second[0]
    return shape_distance(positions, known.shape)[0] + known.shape.size * output


SIGNED_DISTANCES = Operation("signed_distances", signed_distances_reference)
DISTANCE = "ppippipipippfffp"
"""Types of the arguments of compiled functions that describe a distance."""
_values = native.Function("signed_distances", "pq" + DISTANCE + "pi")


@SIGNED_DISTANCES.implementation(FEW_OPERATIONS, types=None, order=torch.inf)
def _few_operations(positions: Tensor, known: SignedDistance) -> Tensor:
    return _around_shape(hash_grid(known.unit(positions), known.table, known.layout), positions, known)


def is_compiled(known: SignedDistance) -> bool:
    """Return whether compiled functions take the sizes and the layout in memory of `known`."""
    tensors = known.table, known.first, known.second
    return known.table.shape[1] in (1, 2, 4, 8) and all(tensor.is_contiguous() for tensor in tensors)


@SIGNED_DISTANCES.implementation(CPP, order=0, differentiable=0, fits=lambda positions, known: is_compiled(known))
def _compiled(positions: Tensor, known: SignedDistance) -> Tensor:
    positions, count = positions.contiguous(), len(positions)
    out = positions.new_empty(count)
    _values(
        native.pointer(positions, "positions", (count, 3)), count, *distance_arguments(known), out.data_ptr(),
        native.threads(),
    )  # fmt: skip
    return out


def distance_arguments(known: SignedDistance) -> tuple[Any, ...]:
    """Check the arguments of compiled calls that evaluate `known`, and return them."""
    table, layout, shape, hidden = known.table, known.layout, known.shape, len(known.first)
    inputs = layout.num_levels * table.shape[1]
    return (
        native.pointer(known.shift, "the shift", (3,)),
        native.pointer(table, "the hash table", (layout.num_entries, table.shape[1])), table.shape[1], *layout.arrays,
        layout.num_levels, native.pointer(known.first, "first weights", (hidden, inputs)), hidden,
        native.pointer(known.second, "second weights", (len(known.second), hidden)), len(known.second),
        native.pointer(shape.centre, "the centre", (3,)), native.pointer(shape.scale, "the scale", (3,)),
        shape.size, shape.radius, shape.rounding, native.pointer(shape.floor, "the floor", (4,)),
    )  # fmt: skip

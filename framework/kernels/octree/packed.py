"""Light along rays through an octree with leaves in bytes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from nerfloom.geometry.rays import Rays
from nerfloom.geometry.records import TensorRecord
from nerfloom.kernels import native
from nerfloom.kernels.dispatch import CPP, TRITON, Operation
from nerfloom.kernels.octree.layout import OctreeLayout
from nerfloom.kernels.octree.light import (
    LAYOUT,
    RAYS,
    OctreeLight,
    check_leaves,
    contiguous,
    light_of,
    outputs_of,
    ray_arguments,
)
from nerfloom.kernels.octree.walk import smallest_cells
from nerfloom.kernels.triton_backend import later

_trace_packed = native.Function("octree_trace_packed", LAYOUT + "pppppi" + RAYS + "ppfpppppi")
CODES = 256
"""Number of codes of a level."""


@dataclass(frozen=True)
class PackedLeaves(TensorRecord):
    """Leaves in bytes."""

    codes: Tensor
    """(L,) uint8 index into the part of `table` for the leaf's level."""
    table: Tensor
    """(256 V,) float32 optical depth of a cell's edge, of each code, for each of V levels."""
    colors: Tensor
    """(L, 3 K) uint8 coefficients of K harmonics, channel by channel."""
    scales: Tensor
    """(3 K,) float32; a coefficient is scale * byte + offset."""
    offsets: Tensor
    """(3 K,) float32."""

    def depths(self, level: Tensor | int = 0) -> Tensor:
        """Return the optical depth (L,) of a cell's edge, of each leaf.

        Args:
            level: (L,) int64 level of each leaf (`OctreeLayout.level_of`), or the level of all.
        """
        return self.table[self.codes.long() + CODES * level]

    def coefficients(self) -> Tensor:
        """Return the coefficients (L, 3 K) of the leaves."""
        return self.colors.float() * self.scales + self.offsets


def trace_packed(
    layout: OctreeLayout, leaves: PackedLeaves, rays: Rays, background: Tensor, stop: float = 0.0
) -> OctreeLight:
    """Return the light of R rays through an octree with leaves in bytes, without gradient.

    Args:
        layout: where the L leaves are.
        leaves: their values.
        rays: the rays. With `pixel_radii`, coarser levels show matter that is small in a pixel (`smallest_cells`).
        background: (R, 3) or (3,) colour of the background.
        stop: transmittance below which a ray ends; see `error_bound`.
    """
    check_leaves(layout, leaves.codes, leaves.colors)
    background = background.expand(len(rays), 3)
    return TRACE_PACKED((rays.origins, rays.directions, background), layout, leaves, rays, background, stop)


def trace_packed_reference(
    layout: OctreeLayout, leaves: PackedLeaves, rays: Rays, background: Tensor, stop: float = 0.0
) -> OctreeLight:
    """Compute `trace_packed` of `layout`, `leaves`, `rays`, `background` and `stop` in PyTorch, for any float type."""
    kind = rays.origins.dtype
    level = layout.level_of(torch.arange(len(leaves.codes), device=leaves.codes.device))
    values = leaves.depths(level).to(kind), leaves.coefficients().to(kind)
    return light_of(layout, *values, rays, background, stop, smallest=smallest_cells(rays))


TRACE_PACKED: Operation[..., OctreeLight] = Operation("trace_packed", trace_packed_reference)


@TRACE_PACKED.implementation(CPP, order=0)
def _packed(
    layout: OctreeLayout, leaves: PackedLeaves, rays: Rays, background: Tensor, stop: float = 0.0
) -> OctreeLight:
    smallest, rays, background = smallest_cells(rays), contiguous(rays), background.contiguous()
    out, addresses = outputs_of(rays)
    count, values = leaves.colors.shape
    _trace_packed(
        *layout.arguments(), native.pointer(leaves.codes, "codes", (count,), torch.uint8),
        native.pointer(leaves.table, "the table", (CODES * len(layout.levels),)),
        native.pointer(leaves.colors, "colours", (count, values), torch.uint8),
        native.pointer(leaves.scales, "scales", (values,)), native.pointer(leaves.offsets, "offsets", (values,)),
        values, *ray_arguments(rays),
        None if smallest is None else native.pointer(smallest, "smallest edges", (len(rays),)),
        native.pointer(background, "the background", (len(rays), 3)), stop, *addresses, native.threads(),
    )  # fmt: skip
    return out


TRACE_PACKED.implementation(TRITON, order=0)(later("octree.trace_triton", "trace_packed"))

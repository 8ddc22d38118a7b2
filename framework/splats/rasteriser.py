"""The part that draws Gaussians: it projects them to an image, lists them by tile, and blends them."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from nerfloom.kernels import native
from nerfloom.kernels.splats.blend import CHANNELS, Blended, blend
from nerfloom.kernels.splats.packed import PackedGaussians, pack_gaussians, packed_sort_keys, project_packed
from nerfloom.kernels.splats.project import MIN_ALPHA, SplatCamera, project_gaussians, sort_keys
from nerfloom.kernels.splats.seam import copies
from nerfloom.kernels.splats.tiles import TileLists, tile_lists
from nerfloom.splats.capacity import Capacity
from nerfloom.splats.gaussians import COLUMNS, MAX_DEGREE, Gaussians
from nerfloom.splats.start import morton

MORTON_CELLS = 2**20
"""Number of cells along an axis for sorting Gaussians along a curve."""


class Projected(NamedTuple):
    """N Gaussians on an image."""

    records: Tensor
    """(N, C) records, in the layout of the rasteriser (`kernels.splats.project.Record`)."""
    keys: Tensor | None = None
    """(N,) positive sort keys, smallest first; None to sort by distance."""


class Rasteriser:
    """The rasteriser of 3D Gaussian Splatting, with compiled kernels where available.

    Another rasteriser overrides one or all of `project`, `tile` and `blend`.
    """

    def project(self, gaussians: Gaussians, camera: SplatCamera, degree: int = MAX_DEGREE) -> Projected:
        """Project Gaussians to an image. Differentiable.

        Args:
            gaussians: N Gaussians.
            camera: the image.
            degree: highest degree of the harmonics in use.
        """
        g = gaussians
        columns = g.means, g.log_scales, g.rotations, g.logits, g.colors, g.harmonics
        records, _ = project_gaussians(*columns, camera=camera, degree=degree)
        return Projected(records, sort_keys(g.means, camera))

    def prepared(self, gaussians: Gaussians) -> Callable[[SplatCamera], Projected] | None:
        """Return a faster `project`, without gradient, for Gaussians that do not change; None if there is none.

        Args:
            gaussians: N Gaussians. Invisible ones may be dropped.
        """
        return None

    def tile(self, shown: Projected, camera: SplatCamera, entries: int | None = None) -> TileLists:
        """List the Gaussians of each tile of an image, from front to back.

        Args:
            shown: N Gaussians on the image.
            camera: the image.
            entries: capacity of the lists; None for no limit.
        """
        gradients = torch.is_grad_enabled()
        return tile_lists(shown.records, camera.width, camera.height, gradients, entries, shown.keys)

    def blend(
        self,
        shown: Projected,
        lists: TileLists,
        camera: SplatCamera,
        background: Tensor,
        channels: int = CHANNELS["rgb"],
        median: bool = False,
    ) -> Blended:
        """Blend Gaussians to an image. Differentiable.

        Args:
            shown: N Gaussians on the image.
            lists: the Gaussians of each tile.
            camera: the image.
            background: (3,) colour behind everything.
            channels: number of channels, a value of `CHANNELS`.
            median: whether to find the median distance. It has no gradient.
        """
        return blend(shown.records, lists, camera.width, camera.height, background, channels, median)

    def draw(
        self,
        shown: Projected,
        camera: SplatCamera,
        background: Tensor,
        channels: int = CHANNELS["rgb"],
        capacity: Capacity | None = None,
        median: bool = False,
    ) -> Blended:
        """Return an image of Gaussians: `tile`, then `blend`. On a panorama, Gaussians on the seam have two sides.

        Args:
            shown, camera, background, channels, median: as in `blend`.
            capacity: estimated capacity of the lists, which avoids a synchronisation.
        """
        shown, pixels = _on_both_sides(shown, camera), camera.width * camera.height
        lists = self.tile(shown, camera, None if capacity is None else capacity.of(shown.records, pixels))
        if capacity is not None:
            capacity.note(shown.records, pixels, lists)
        return self.blend(shown, lists, camera, background, channels, median)


def _on_both_sides(shown: Projected, camera: SplatCamera) -> Projected:
    """Return Gaussians on an image, those across the seam of a panorama with their copies."""
    if camera.turn is None:
        return shown
    indices, records = copies(shown.records, camera.width, camera.turn)
    keys = None if shown.keys is None else torch.cat([shown.keys, shown.keys[indices]])
    return Projected(torch.cat([shown.records, records]), keys)


class PackingRasteriser(Rasteriser):
    """A rasteriser that packs unchanging Gaussians, on a CPU with compiled kernels."""

    def prepared(self, gaussians: Gaussians) -> Callable[[SplatCamera], Projected] | None:
        if not native.available() or gaussians.means.device.type != "cpu" or (found := packed(gaussians)) is None:
            return None
        return lambda camera: Projected(project_packed(found, camera), packed_sort_keys(found, camera))


RASTERISER = PackingRasteriser()
"""The default rasteriser."""


def packed(gaussians: Gaussians) -> PackedGaussians | None:
    """Pack Gaussians along a curve through space, without invisible ones; None if all are invisible.

    Args:
        gaussians: N Gaussians, not modified.
    """
    shown = gaussians[gaussians.finite() & (gaussians.rotations.square().sum(1) > 1e-24)]
    shown = shown[torch.sigmoid(shown.logits) > MIN_ALPHA]
    if not len(shown):
        return None
    shown = shown[along_curve(shown.means)]
    return pack_gaussians(*(getattr(shown, name) for name in COLUMNS))


def along_curve(means: Tensor) -> Tensor:
    """Return the order (N,) of positions along a curve through the box of all but the farthest hundredths.

    Args:
        means: (N, 3) positions, N at least 1.
    """
    count = len(means)
    ordered = means.sort(dim=0).values
    low, high = ordered[count // 100], ordered[count - 1 - count // 100]
    cells = (means - low) / (high - low).clamp(min=1e-20) * (MORTON_CELLS - 1)
    return morton(cells.clamp(0, MORTON_CELLS - 1).long()).argsort()

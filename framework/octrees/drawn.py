"""Renderables that show an octree, and fixed octrees, such as from a file."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from functools import cached_property

import torch
from torch import Tensor

from nerfloom.base.device import runs_ahead
from nerfloom.cameras.cameras import subpixels
from nerfloom.cameras.view import View
from nerfloom.data.scene import Scene
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.octree.layout import OctreeLayout
from nerfloom.kernels.octree.light import OctreeLight, error_bound
from nerfloom.kernels.octree.packed import CODES, trace_packed
from nerfloom.kernels.octree.walk import leaf_at, smallest_cells
from nerfloom.octrees.coarser import with_levels
from nerfloom.octrees.octree import Octree
from nerfloom.renderable import RendersRays
from nerfloom.rendering.outputs import Output
from nerfloom.rendering.rendered import Picture, Rendered
from nerfloom.rendering.volume import mean_distance

RAYS_AT_ONCE = 2**18
"""Number of rays that are traced in one call."""
LEAVES = Output("leaves", "scalar", "leaves that a ray meets")
"""Number of leaves that the ray of a pixel meets before it ends: the work that the pixel takes."""


class DrawsOctree(RendersRays):
    """A renderable that shows the light through an octree."""

    early_stop: float = 1 / 255
    """Maximum error of a colour channel in [0, 1] from ending rays where little light is left."""

    @property
    @abstractmethod
    def layout(self) -> OctreeLayout:
        """The places of the L leaves."""

    @abstractmethod
    def depths(self, leaves: Tensor | None = None) -> Tensor:
        """Return the optical depth (N,) of a cell's edge in some leaves, without gradient.

        Args:
            leaves: (N,) int64 their indices; None for all.
        """

    @abstractmethod
    def coefficients(self) -> Tensor:
        """Return the coefficients (L, 3 K) of the leaves' harmonics, without gradient."""

    @abstractmethod
    def light(self, rays: Rays, background: Tensor, stop: float) -> OctreeLight:
        """Return the light of R rays.

        Args:
            rays: the rays.
            background: (R, 3) or (3,) colour of the background.
            stop: transmittance below which a ray ends.
        """

    @property
    @abstractmethod
    def largest(self) -> float:
        """Largest error of a colour channel of a ray that ends at once: `error_bound` at a transmittance of 1."""

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        """Render R rays, perhaps 0; colours are not clamped."""
        light = self.light(rays, background, self.early_stop / self.largest)
        visits = light.visits.sum()
        return Rendered(
            rgb=light.color,
            depth=mean_distance(light.moment, light.opacity.detach(), rays.fars),
            median_depth=light.median,
            accumulation=light.opacity,
            num_samples=visits if torch.is_grad_enabled() and runs_ahead(visits.device) else int(visits),
            extras={LEAVES.name: light.visits.float()},
            error_bound=self.early_stop,
        )

    def density(self, points: Points) -> Tensor:
        """Return the density (N,) at `points`, in 1/length."""
        leaf = leaf_at(self.layout, points.positions)
        met, density = leaf >= 0, torch.zeros(len(leaf), device=leaf.device)
        density[met] = self.depths(leaf[met]) / self.layout.edges_of(leaf[met], density.dtype)
        return density

    @property
    def outputs(self) -> tuple[Output, ...]:
        return (LEAVES,)

    @property
    def rays_at_once(self) -> int:
        """Number of rays that are traced in one call."""
        return RAYS_AT_ONCE

    @torch.no_grad()
    def render_view(self, view: View, background: Tensor) -> Picture:
        per_pixel, pixels = view.rays_per_pixel or self.rays_per_pixel, view.pixels()
        offsets, background = subpixels(per_pixel, self.device), background.to(self.device, torch.float32)
        parts = []
        with self.rendering():
            for some in pixels.reshape(-1).split(max(self.rays_at_once // per_pixel, 1)):
                rays = view.camera.pixel_rays(some, self.scene.near, self.scene.far, None, offsets)
                radii = None if rays.pixel_radii is None else rays.pixel_radii / per_pixel**0.5
                rendered = self.render(replace(rays, camera_indices=None, pixel_radii=radii), background)
                parts.append(rendered.to_pixels(per_pixel, self.outputs))
        size = tuple(pixels.shape)
        return Picture(
            torch.cat([part.rgb for part in parts]).clamp(0, 1).view(*size, 3),
            torch.cat([part.depth for part in parts]).view(size),
            torch.cat([part.median_depth for part in parts]).view(size),
            torch.cat([part.accumulation for part in parts]).view(size),
            {LEAVES.name: torch.cat([part.extras[LEAVES.name] for part in parts]).view(size)},
            self.outputs,
            num_rays=pixels.numel() * per_pixel,
        )


class DrawnOctree(DrawsOctree):
    """A renderable of an octree that does not change.

    Pictures from afar use coarser levels, which are derived when the first such picture is drawn.

    Args:
        octree: the octree, on the device that renders it.
        scene: the scene that defines its frame.
    """

    def __init__(self, octree: Octree, scene: Scene) -> None:
        self.octree, self.scene = octree, scene
        self._largest = error_bound(octree.leaves.coefficients(), 1.0)

    @property
    def device(self) -> torch.device:
        return self.octree.layout.origin.device

    @property
    def layout(self) -> OctreeLayout:
        return self.octree.layout

    def depths(self, leaves: Tensor | None = None) -> Tensor:
        packed = self.octree.leaves
        chosen = torch.arange(len(packed.codes), device=self.device) if leaves is None else leaves
        return packed.table[packed.codes[chosen].long() + CODES * self.layout.level_of(chosen)]

    def coefficients(self) -> Tensor:
        return self.octree.leaves.coefficients()

    @property
    def largest(self) -> float:
        return max(self._largest, 1.0)

    def light(self, rays: Rays, background: Tensor, stop: float) -> OctreeLight:
        octree = self._from_afar(rays)
        if octree is None:
            octree, rays = self.octree, replace(rays, pixel_radii=None)
        return trace_packed(octree.layout, octree.leaves, rays, background, stop)

    @cached_property
    def _with_levels(self) -> Octree:
        return with_levels(self.octree)

    def _from_afar(self, rays: Rays) -> Octree | None:
        """Return the octree with the levels that rays may need; None if no pixel is wide in its smallest box.

        In boxes around it, cells and the width of pixels grow alike.
        """
        smallest = smallest_cells(rays)
        if smallest is None or not len(rays):
            return None
        low, high = rays.origins.aminmax(dim=0)
        first, last = self.layout.box
        edge = float(smallest.amax() * torch.maximum(high - first, last - low).norm())
        if not edge > self.layout.cell:
            return None
        levels = self._with_levels.layout.levels
        return self._with_levels.finest(max(1 + sum(level.cell < edge for level in levels), len(self.layout.levels)))

"""A truncated signed distance (TSDF), fused from the depth images that a model renders: Curless and Levoy 1996.

It works with every method that renders depth. Each lattice point near a surface gets the mean distance from the point
to the surface seen in its pixel, over all views where the point is not hidden, truncated at a few cells. Views are
weighted by the angle between ray and surface. The lattice is processed in blocks, so that memory holds the views and
one batch of blocks.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nerfloom.base.errors import FlagError
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.view import View
from nerfloom.export.lattice import Lattice
from nerfloom.geometry.lenses import project
from nerfloom.renderable import Renderable

BLOCK = 16
"""Cells along an edge of a block."""
BLOCKS_AT_ONCE = 48
"""Number of blocks with points projected at once."""
OPAQUE = 0.5
"""Minimum opacity of a pixel that shows a surface; others show empty space up to the scene's far end."""
MIN_WEIGHT = 0.05
"""Weight of a view that sees the surface at a right angle to its normal; one that looks along the normal weighs 1."""
MAX_PIXELS = 30_000_000
"""Maximum number of pixels of all views together, which take 270 MB."""


@dataclass(frozen=True)
class DepthView:
    """A view with its rendered depth and colours, on the CPU."""

    camera: Cameras
    """One camera, for the full image."""
    stride: int
    """Distance between rendered rows and columns; the first is `stride // 2`."""
    depth: Tensor
    """(H, W) distance along the ray to the median surface, scene units; inf where the ray meets nothing, and NaN where
    that is unknown."""
    rgb: Tensor
    """(H, W, 3) uint8 colours."""
    weight: Tensor
    """(H, W) float16 weight, the cosine between the ray and the normal of the surface."""

    def lookup(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the pixel (N,) int64 of `points` (N, 3), counted row by row, whether they have one, and distances.

        The distance is that along the pixel's ray, scene units.
        """
        camera, pose = self.camera, self.camera.camera_to_worlds[0]
        local = (points - pose[:, 3]) @ pose[:, :3]
        x, y, visible = project(camera.model, local, camera.distortion)
        height, width = self.depth.shape
        # Pixel i of the full image has its centre at i + 0.5.
        middle = 0.5 + self.stride // 2
        column = ((x * camera.fx + (camera.cx - middle)) / self.stride).round_()
        row = ((y * camera.fy + (camera.cy - middle)) / self.stride).round_()
        visible = visible & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        pixel = (row * width + column).where(visible, 0).long()
        return pixel, visible, -local[:, 2] if camera.model == "orthographic" else local.norm(dim=-1)


def stride_for(cameras: Cameras, lattice: Lattice, most_pixels: int = MAX_PIXELS) -> int:
    """Return the stride that puts neighbouring pixels about a cell apart at the centre of the lattice.

    Args:
        cameras: the cameras to be rendered.
        most_pixels: maximum number of pixels of all views together.
    """
    middle = lattice.positions(torch.tensor([lattice.cells]) / 2)
    distance = float((cameras.camera_to_worlds[:, :, 3].cpu() - middle).norm(dim=-1).median())
    apart = 1.0 if cameras.model == "orthographic" else distance
    fine = int(lattice.spacing * float(cameras.fx.median()) / max(apart, 1e-9))
    total = int((cameras.widths * cameras.heights).sum())
    return max(fine, math.ceil(math.sqrt(total / most_pixels)), 1)


@torch.no_grad()
def rendered_views(
    model: Renderable, cameras: Cameras, times: Tensor | None, background: Tensor, stride: int
) -> Iterator[DepthView]:
    """Render depth and colour of each camera.

    Args:
        model: the model in evaluation mode.
        cameras: M cameras on the model's device.
        times: (M,) times of the views; None for a static scene.
        background: (3,) colour behind the scene.
        stride: distance between the rendered rows and columns.
    """
    for index in range(len(cameras)):
        view = View.of(cameras, index, times, stride)
        picture = model.render_view(view, background)
        depth = picture.median_depth.float().cpu()
        depth = torch.where(picture.accumulation.cpu() >= OPAQUE, depth, torch.where(depth.isnan(), depth, torch.inf))
        # Where nothing is met, or only at the very end of the ray, which is where empty rays are said to end.
        depth = torch.where(depth >= 0.999 * model.scene.far, torch.inf, depth)
        camera = view.camera.to("cpu")
        rays = camera.pixel_rays(view.pixels().cpu().reshape(-1), 0.0, 1.0)
        origins, directions = (part.view(*depth.shape, 3) for part in (rays.origins, rays.directions))
        yield DepthView(
            camera,
            stride,
            depth,
            (picture.rgb.clamp(0, 1) * 255).round().to(torch.uint8).cpu(),
            _facing(origins + depth[..., None] * directions, directions).half(),
        )


def _facing(points: Tensor, directions: Tensor) -> Tensor:
    """Return the weight (H, W) of each pixel of a depth image: the cosine of its ray's angle to the surface normal.

    Args:
        points: (H, W, 3) points on the surface, not finite where there is none.
        directions: (H, W, 3) unit directions of the rays.
    """
    padded = torch.nn.functional.pad(points.permute(2, 0, 1)[None], (1, 1, 1, 1), mode="replicate")[0].permute(1, 2, 0)
    across, down = padded[1:-1, 2:] - padded[1:-1, :-2], padded[2:, 1:-1] - padded[:-2, 1:-1]
    normal = torch.linalg.cross(across, down)
    cosine = (normal * directions).sum(-1).abs() / normal.norm(dim=-1).clamp(min=1e-20)
    return torch.where(cosine.isfinite(), cosine, 0).clamp(MIN_WEIGHT, 1)


def surface_points(view: DepthView) -> Tensor:
    """Return the points (K, 3) where the rays of `view` meet a surface, scene coordinates."""
    height, width = int(view.camera.heights[0]), int(view.camera.widths[0])
    grid = torch.arange(height * width).view(height, width)[
        view.stride // 2 :: view.stride, view.stride // 2 :: view.stride
    ]
    met = view.depth.isfinite()
    rays = view.camera.pixel_rays(grid[met], 0.0, 1.0)
    return rays.origins + view.depth[met][:, None] * rays.directions


class FusedDistance:
    """The fused distance at lattice points.

    Args:
        lattice: the points.
        views: the rendered views.
        truncation: truncation distance, in cells.

    Raises:
        ConfigError: if the truncation is less than one cell.
    """

    def __init__(self, lattice: Lattice, views: Sequence[DepthView], truncation: float) -> None:
        if not 1 <= truncation <= 64:
            raise FlagError(f"--truncation is {truncation:g}; it must be from 1 to 64 cells")
        self.lattice, self.views = lattice, views
        self.cells, self.truncation = truncation, truncation * lattice.spacing

    def blocks(self) -> list[Tensor]:
        """Return the blocks (3,) within the truncation of a surface in any view."""
        counts = torch.tensor(self.lattice.block_counts(BLOCK))
        offsets = self.cells * (2.0 * torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3) - 1)
        met = torch.zeros(0, dtype=torch.int64)
        for view in self.views:
            middles = self.lattice.indices(surface_points(view))
            touched = torch.zeros(0, dtype=torch.int64)
            for offset in offsets:
                block = ((middles + offset) / BLOCK).floor().long()
                block = block[((block >= 0) & (block < counts)).all(-1)]
                number = (block[:, 0] * counts[1] + block[:, 1]) * counts[2] + block[:, 2]
                touched = torch.cat([touched, number.unique()])
            met = torch.cat([met, touched]).unique()
        return list(torch.stack([met // (counts[1] * counts[2]), met // counts[2] % counts[1], met % counts[2]], -1))

    def valued(self, blocks: Sequence[Tensor]) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield `blocks` (3,) with their values for `isosurface`, positive behind the surface."""
        for start in range(0, len(blocks), BLOCKS_AT_ONCE):
            chosen = blocks[start : start + BLOCKS_AT_ONCE]
            points = [self.lattice.block_points(block, BLOCK)[0] for block in chosen]
            values = self.values(self.lattice.positions(torch.cat(points)).float())
            yield from zip(chosen, values.split([len(part) for part in points]), strict=True)

    def values(self, points: Tensor) -> Tensor:
        """Return values (N,) in [-1, 1] at `points` (N, 3) in scene coordinates, NaN where no view sees them."""
        total, weights = torch.zeros(len(points)), torch.zeros(len(points))
        for view in self.views:
            pixel, visible, distance = view.lookup(points)
            behind = distance - view.depth.reshape(-1)[pixel]  # NaN, and so not used, where the depth is
            used = visible & (behind < self.truncation)
            weight = view.weight.reshape(-1)[pixel].float() * used
            total += torch.where(used, (behind / self.truncation).clamp(min=-1), 0.0) * weight
            weights += weight
        return torch.where(weights > 0, total / weights, torch.nan)

    def colors(self, vertices: Tensor, normals: Tensor) -> Tensor:
        """Return the mean colour (V, 3) of `vertices` with `normals` (V, 3) in the views that see them, else NaN."""
        vertices, total = vertices.float(), torch.zeros(len(vertices), 3)
        weights = torch.zeros(len(vertices))
        for view in self.views:
            pixel, visible, distance = view.lookup(vertices)
            pose = view.camera.camera_to_worlds[0]
            towards = pose[:, 2].expand_as(vertices) if view.camera.model == "orthographic" else pose[:, 3] - vertices
            cosine = (towards * normals).sum(-1) / towards.norm(dim=-1).clamp(min=1e-12)
            near = (distance - view.depth.reshape(-1)[pixel]).abs() < self.truncation
            weight = torch.where(visible & near, cosine.clamp(min=0).square(), 0.0)
            total += view.rgb.reshape(-1, 3)[pixel] / 255 * weight[:, None]
            weights += weight
        return torch.where(weights[:, None] > 1e-6, total / weights[:, None], torch.nan)

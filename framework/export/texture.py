"""Textures of meshes: an image, and the place on it of each triangle.

The image is divided into squares, and each holds two triangles of equal size. This wastes more space than charts
of neighbouring triangles, but it works for every mesh, takes no time and needs no package. Each triangle owns all
texels that its interpolation reads, so that other colours do not bleed into it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from nerfloom.base.console import say, track
from nerfloom.base.errors import ConfigError

MIN_SQUARE = 5
"""Minimum edge of a square, in texels: the legs of its triangles are three shorter."""
CHUNK = 1 << 17
"""Maximum number of texels that are coloured at once."""


@dataclass(frozen=True)
class Texture:
    """An image, and the place on it of each corner of a mesh's faces."""

    image: Tensor
    """(S, S, 3) uint8 colours, the first row at the top."""
    coordinates: Tensor
    """(F, 3, 2) from the left and from the bottom, in [0, 1]."""


@dataclass(frozen=True)
class Atlas:
    """The squares of an image: two triangles each, the second one turned by 180 degrees."""

    size: int
    """Edge of the image, texels."""
    num_faces: int
    """Number of triangles."""

    @property
    def columns(self) -> int:
        """Number of squares along an edge."""
        return max(math.ceil(math.sqrt(math.ceil(self.num_faces / 2))), 1)

    @property
    def side(self) -> int:
        """Edge of a square, texels."""
        return self.size // self.columns

    def check(self) -> None:
        """Raise ConfigError if triangles would be too small."""
        if self.side < MIN_SQUARE:
            needed = MIN_SQUARE * self.columns
            raise ConfigError(
                f"a texture of {self.size} x {self.size} texels is too small for {self.num_faces:,} faces: give "
                f"--texture-size {needed} or --target-num-faces {2 * (self.size // MIN_SQUARE) ** 2}"
            )

    def corners(self) -> Tensor:
        """Return the corners (F, 3, 2) of all triangles, float64 texels from the left and from the top."""
        faces, leg = torch.arange(self.num_faces), self.side - 3
        own = torch.tensor([[0, 0], [leg, 0], [0, leg]]).double() + 0.5
        within = torch.where((faces % 2 == 0)[:, None, None], own, self.side - own)
        square = faces // 2
        place = torch.stack([square % self.columns, square // self.columns], -1) * self.side
        return within + place[:, None]

    def coordinates(self) -> Tensor:
        """Return the corners (F, 3, 2) of all triangles, from the left and from the bottom, in [0, 1]."""
        across, down = (self.corners() / self.size).unbind(-1)
        return torch.stack([across, 1 - down], -1).float()

    def texels(self, first: int, last: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return the texels that some faces own: places in the image, faces and barycentric coordinates.

        Args:
            first: first face, an even number.
            last: the face after the last one.

        Returns:
            Index (T,) int64 of each texel, row by row, its face (T,) int64, and its position (T, 3) float64 in
            barycentric coordinates, none below 0: a texel beside its triangle has the colour of the edge.
        """
        side, leg = self.side, self.side - 3
        down, right = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
        # Interpolation in the first triangle reads texels up to this diagonal, and in the second those behind it.
        second = (right + down >= side).reshape(-1)
        right, down = right.reshape(-1), down.reshape(-1)
        along = torch.where(second[:, None], side - 1 - torch.stack([right, down], -1), torch.stack([right, down], -1))
        shares = along.double() / leg
        weights = torch.cat([1 - shares.sum(-1, keepdim=True), shares], -1).clamp(min=0)
        weights /= weights.sum(-1, keepdim=True)
        squares = torch.arange(first // 2, -(-last // 2))
        column, row = squares % self.columns * side, squares // self.columns * side
        places = (row[:, None] + down) * self.size + column[:, None] + right
        faces = 2 * squares[:, None] + second
        owned = faces < last
        return places[owned], faces[owned], weights.expand(len(squares), -1, -1)[owned]


def painted(
    vertices: Tensor,
    normals: Tensor,
    vertex_colors: Tensor,
    faces: Tensor,
    colors: Callable[[Tensor, Tensor], Tensor],
    size: int,
    max_seconds: float,
) -> Texture:
    """Return a texture that has, at each texel, the colour of the surface there.

    Args:
        vertices: (V, 3) positions.
        normals: (V, 3) unit normals.
        vertex_colors: (V, 3) in [0, 1], for texels without a colour of their own.
        faces: (F, 3) int64 indices of vertices.
        colors: function from positions and normals (T, 3) to colours (T, 3), NaN where there is none.
        size: edge of the image, texels.
        max_seconds: time limit, seconds. Remaining texels then get the colours of the vertices.

    Raises:
        ConfigError: if the image is too small for that many faces.
    """
    atlas = Atlas(size, len(faces))
    atlas.check()
    image = torch.full((atlas.size**2, 3), 127, dtype=torch.uint8)
    step = max(CHUNK // atlas.side**2, 1) * 2
    end, late = time.monotonic() + max_seconds, 0
    chunks = range(0, len(faces), step)
    for first in track(chunks, "Painting the texture", total=len(chunks)):
        places, owners, weights = atlas.texels(first, min(first + step, len(faces)))
        corners = faces[owners]

        def between(values: Tensor, corners: Tensor = corners, weights: Tensor = weights) -> Tensor:
            return (weights[:, :, None] * values[corners]).sum(1)

        found = between(vertex_colors.double()).float()
        if time.monotonic() < end:
            outwards = torch.nn.functional.normalize(between(normals.double()), dim=-1)
            seen = colors(between(vertices.double()), outwards.float())
            found = torch.where(seen.isnan().any(-1, keepdim=True), found, seen)
        else:
            late += len(owners.unique())
        image[places] = (found.clamp(0, 1) * 255).round().to(torch.uint8)
    if late:
        say(
            f"{late:,} of {len(faces):,} faces have the colours of their vertices only, as the time for the texture "
            "was over (--texture-seconds)"
        )
    return Texture(image.view(atlas.size, atlas.size, 3), atlas.coordinates())

"""The light of images: functions from the scene's rendered colours to the colours of each image.

A function has parameters for each image, in a row of an `Appearance`, and a row of zeros changes nothing. It maps
colours of surfaces, before they are composited over the background, so the background keeps its own colour.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from nerfloom.base.config import AppearanceConfig
from nerfloom.base.optimised import Optimised
from nerfloom.data.scene import Scene
from nerfloom.fields.appearance import Appearance
from nerfloom.kernels.table_memory import require
from nerfloom.rendering.bilateral_grid import luminance, sliced, sliced_image, variation
from nerfloom.rendering.tone import INTERVALS, exposed, tone_curve

AFFINE = 12
"""Number of parameters of an affine function of colours, the rows of a matrix (3, 4)."""
GRID = (4, 8, 8)
"""Vertices of a bilateral grid: levels of luminance, rows and columns. Wang et al. 2024 have 8, 16 and 16; smaller
grids learn from fewer pixels."""
RATE = 1e-3
"""Initial learning rate of the parameters."""
STOPS = 3.0
"""Stops per unit of an exposure's parameter. A step of Adam then changes mid grey by a similar amount as in affine
functions."""
PULL = 1e-2
"""Weight of the mean squared distance of parameters from the identity's, beside an absolute error."""
SMOOTHNESS = 2.0
"""Weight of the total variation of bilateral grids. In Wang et al. 2024 it is 10, and neighbours are half as far apart,
so that differences between them are half as large."""
SQUARED = 0.1
"""Factor of the penalty beside a squared error of colours, which is smaller than an absolute one."""
FITTED = 0.01
"""Factor of the penalty beside a squared error in fits of one image. It is smaller than `SQUARED`, since the image's
light may be far from the others': it only decides where the image's pixels do not."""
LEAST_OPACITY = 1e-3
"""Minimum opacity; a colour with less is not divided by its opacity."""


def without_background(rgb: Tensor, opacity: Tensor, background: Tensor) -> Tensor:
    """Return colour times opacity, and opacity, (..., 4).

    Args:
        rgb: (..., 3) colours over the background.
        opacity: (...) opacity.
        background: (3,) or (..., 3) colour of the background.
    """
    return torch.cat([rgb - (1 - opacity)[..., None] * background, opacity[..., None]], dim=-1)


def transformed(seen: Tensor, affine: Tensor) -> Tensor:
    """Return affine functions of colours, times opacity, (..., 3).

    This equals transforming the colour of each sample before it is composited.

    Args:
        seen: (..., 4) colour times opacity, and opacity.
        affine: (3, 4) matrix of one function, or (..., 3, 4) one for each colour.
    """
    return seen @ affine.T if affine.dim() == 2 else (affine * seen[..., None, :]).sum(-1)


class Light(Appearance, ABC):
    """A function of rendered colours for each image, with learnt parameters.

    Args:
        size: number D of parameters of an image.
    """

    placed: ClassVar[bool] = False
    """Whether the function depends on the position in the image (`Rays.places`)."""
    cells: ClassVar[int] = 1
    """Number of functions among the parameters of an image; the penalty is their mean."""

    def __init__(self, size: int, config: AppearanceConfig, scene: Scene) -> None:
        require(4.0 * size * scene.num_cameras, "the appearance of all images")
        optimised = Optimised("appearance", RATE)
        super().__init__(size, scene.num_cameras, optimised, config.mean_appearance_share, config.eval_appearance)

    def lit(
        self,
        rgb: Tensor,
        opacity: Tensor,
        background: Tensor,
        images: Tensor | None = None,
        places: Tensor | None = None,
    ) -> Tensor:
        """Return colours as images show them, in the shape of `rgb`.

        Args:
            rgb: (N, 3) colours of rays, or (H, W, 3) of all pixels of an image, over the background.
            opacity: (N,) or (H, W) opacity.
            background: (3,) or (N, 3) colour of the background.
            images: (N,) training image of each ray, or (1,) of all; None for the appearance of evaluation.
            places: (N, 2) position of each ray in its image, from the left and top edge, 0 to 1; None for the middle.
                It is not used for an image, which has all positions.
        """
        seen = without_background(rgb, opacity, background)
        with torch.autocast(rgb.device.type, torch.bfloat16, enabled=False):
            if images is None:
                return rgb + self.change(seen, self.current()[None], self._first(rgb), places)
            return rgb + self.change(seen, self.own_or_mean(), images, places)

    @abstractmethod
    def change(self, seen: Tensor, rows: Tensor, which: Tensor, places: Tensor | None) -> Tensor:
        """Return by how much colours change, times opacity, (N, 3) or (H, W, 3).

        Args:
            seen: (N, 4) or (H, W, 4) colour times opacity, and opacity.
            rows: (K, D) parameters.
            which: (N,) or (1,) int64, the row of each colour, or of all.
            places: as in `lit`.
        """

    def away(self) -> Tensor:
        """Return the distance of each image's own parameters (M, D) from the expected ones: zeros here."""
        return self.vectors

    def penalty(self) -> Tensor:
        """Return the term () of the loss that pulls functions to the identity, beside an absolute error of colours.

        Light and the scene's colours can change together without changing any image. So each image's parameters are
        pulled a little, and their mean is pulled to where it changes nothing: it is then neutral.
        """
        away = self.away()
        return (PULL * away.square().sum(-1).mean() + away.mean(0).square().sum()) / self.cells

    def pull(self, vector: Tensor) -> Tensor:
        return FITTED * PULL * vector[: self.size].square().sum() / self.cells

    def _first(self, rgb: Tensor) -> Tensor:
        return torch.zeros(1, dtype=torch.int64, device=rgb.device)


class AffineLight(Light):
    """An affine function of colours for each image: rgb + A rgb + b. It covers exposure and white balance."""

    def __init__(self, config: AppearanceConfig, scene: Scene) -> None:
        super().__init__(AFFINE, config, scene)

    def change(self, seen: Tensor, rows: Tensor, which: Tensor, places: Tensor | None) -> Tensor:
        affine = functional.embedding(which, rows).unflatten(-1, (3, 4))
        return transformed(seen, affine[0] if len(affine) == 1 else affine)


class ToneLight(Light):
    """Exposure and white balance of each image, and a tone curve of each camera (`rendering.tone`).

    Exposures start from the values in the images' files. A vector holds exposure, white balance of red and of blue,
    in units of `STOPS`, and the logarithms of the curve's slopes.
    """

    devices: Tensor
    start: Tensor

    def __init__(self, config: AppearanceConfig, scene: Scene) -> None:
        super().__init__(3, config, scene)
        devices = torch.zeros(scene.num_cameras, dtype=torch.int64) if scene.devices is None else scene.devices
        stated = torch.zeros(scene.num_cameras) if scene.exposures is None else scene.exposures
        self.register_buffer("devices", devices.clone())
        self.register_buffer("start", stated / STOPS)
        self.curves = nn.Parameter(torch.zeros(int(devices.max()) + 1, INTERVALS))
        with torch.no_grad():
            self.vectors[:, 0] = self.start

    def of_images(self) -> Tensor:
        return torch.cat([self.vectors, functional.embedding(self.devices, self.curves)], dim=-1)

    def away(self) -> Tensor:
        return torch.cat([self.vectors[:, :1] - self.start[:, None], self.vectors[:, 1:]], dim=-1)

    def penalty(self) -> Tensor:
        # A curve is not pulled as a mean: with other exposures, the scene's colours cannot take its place.
        return super().penalty() + PULL * self.curves.square().sum(-1).mean()

    def change(self, seen: Tensor, rows: Tensor, which: Tensor, places: Tensor | None) -> Tensor:
        row, flat = functional.embedding(which, rows), seen.reshape(-1, 4)
        colors, exposure = surface_colors(flat), row[:, 0]
        stops = STOPS * torch.stack([exposure + row[:, 1], exposure, exposure + row[:, 2]], dim=-1)
        shown = tone_curve(exposed(colors, stops), row[:, 3:])
        return (flat[:, 3:] * (shown - colors)).view(*seen.shape[:-1], 3)


class GridLight(Light):
    """A bilateral grid of affine functions of colours for each image (`rendering.bilateral_grid`)."""

    placed = True
    cells = math.prod(GRID)

    def __init__(self, config: AppearanceConfig, scene: Scene) -> None:
        super().__init__(self.cells * AFFINE, config, scene)

    def change(self, seen: Tensor, rows: Tensor, which: Tensor, places: Tensor | None) -> Tensor:
        guide = luminance(surface_colors(seen))
        if seen.dim() == 3:
            affine = sliced_image(functional.embedding(which, rows).view(*GRID, AFFINE), guide)
        else:
            places = guide.new_full((len(guide), 2), 0.5) if places is None else places
            affine = sliced(rows.view(-1, *GRID, AFFINE), which.expand(len(guide)), places, guide)
        return transformed(seen, affine.unflatten(-1, (3, 4)))

    def penalty(self) -> Tensor:
        return super().penalty() + SMOOTHNESS * variation(self.vectors.view(-1, *GRID, AFFINE))

    def pull(self, vector: Tensor) -> Tensor:
        return super().pull(vector) + FITTED * SMOOTHNESS * variation(vector.view(1, *GRID, AFFINE))

    def of_any_view(self, vector: Tensor) -> Tensor:
        grid = vector.view(*GRID, AFFINE)
        return grid.mean((1, 2), keepdim=True).expand_as(grid).reshape(-1)


def surface_colors(seen: Tensor) -> Tensor:
    """Return the colours of surfaces (..., 3) before they are composited.

    Args:
        seen: (..., 4) colour times opacity, and opacity.
    """
    return seen[..., :3] / seen[..., 3:].clamp(min=LEAST_OPACITY)


LIGHTS: dict[str, type[AffineLight] | type[ToneLight] | type[GridLight]] = {
    "affine": AffineLight,
    "tone": ToneLight,
    "grid": GridLight,
}
"""Functions of rendered colours, by kind of appearance."""


def make_light(config: AppearanceConfig, scene: Scene) -> Light | None:
    """Return the light of the training images; None if the settings have no function of rendered colours."""
    kind = LIGHTS.get(config.appearance)
    return None if kind is None else kind(config, scene)

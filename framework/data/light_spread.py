"""Differences in light, exposure and white balance between the images of a scene.

Images of different content differ in colour even in the same light. But if the light changes, dark and bright parts
change together. So an image is described by quantiles, and a change common to all quantiles is attributed to the light.
Images are compared with those that show the same: with all others if the cameras look at one place, such as a statue,
else with the images around them. In steady light the sides of a street differ as much as changing light would make
them.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from nerfloom.cameras.poses import looked_at

MAX_PIXELS = 4096
"""Maximum number of pixels of an image used."""
QUANTILES = (10, 25, 50, 75, 90)
"""Quantiles, per cent."""
MIN_PIXELS = 64
"""Minimum number of usable pixels; images with fewer are ignored."""
APPEARANCE_STOPS = 0.13
"""Minimum spread in stops for varying light. Five of seven captures, in steady light, had 0.02 to 0.09; one with dimmed
lamps had 0.20, and one gathered from many cameras and days had 0.29."""
AROUND, MIN_AROUND = 16, 4
"""If the cameras look at no common point, an image is compared with one in `AROUND` of the images, the nearest ones
that look in nearly the same direction, but with at least `MIN_AROUND`."""
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def light_of(image: np.ndarray, kept: np.ndarray | None = None) -> np.ndarray:
    """Return quantiles of an image's luminance and colour ratios.

    Args:
        image: (H, W, 3 or 4) uint8; pixels that are not opaque are ignored.
        kept: (H, W) bool, pixels to use; None for all.

    Returns:
        (3, Q) float32, in stops: quantiles of log2 of luminance, red over green, and blue over green. NaN if too few
        pixels are usable.
    """
    step = max(int(np.ceil(np.sqrt(image.shape[0] * image.shape[1] / MAX_PIXELS))), 1)
    pixels = image[step // 2 :: step, step // 2 :: step].reshape(-1, image.shape[2])
    usable = np.ones(len(pixels), bool) if kept is None else kept[step // 2 :: step, step // 2 :: step].reshape(-1)
    if image.shape[2] == 4:
        usable = usable & (pixels[:, 3] == 255)
    if usable.sum() < MIN_PIXELS:
        return np.full((3, len(QUANTILES)), np.nan, np.float32)
    stored = pixels[usable, :3] / 255
    linear = np.where(stored <= 0.04045, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4)
    # The offsets limit the influence of dark pixels: nine stops below white for luminance, and 0.01 for colours, which
    # are noise in the dark.
    light = np.log2(linear @ _LUMINANCE + 2**-9)
    red, blue = (np.log2((linear[:, c] + 0.01) / (linear[:, 1] + 0.01)) for c in (0, 2))
    return np.stack([np.percentile(values, QUANTILES) for values in (light, red, blue)]).astype(np.float32)


def light_spread(light: Tensor, poses: Tensor) -> float:
    """Return the spread of the light between images, in stops.

    For each image, the quantiles are compared with their medians over the images that show the same. If all differences
    have the same sign, the smallest one counts; otherwise 0 does. The result is the largest, over luminance and both
    colour ratios, of the root mean square over the images. Light that changes slowly along a walk is not found.

    Args:
        light: (M, 3, Q) `light_of` each of M images.
        poses: (M, 3, 4) camera-to-world, OpenGL axes.
    """
    usable = torch.isfinite(light).all(-1).all(-1)
    light, poses = light[usable].double(), poses.to(light.device)[usable]
    if len(light) < 2:
        return 0.0
    if looked_at(poses) is None:
        usual = torch.stack([light[_around(poses, index)].quantile(0.5, dim=0) for index in range(len(poses))])
    else:
        usual = light.quantile(0.5, dim=0)
    change = light - usual
    together = (change.sign() == change[..., :1].sign()).all(-1)
    shift = torch.where(together, change.abs().amin(-1), 0.0)
    return float(shift.square().mean(0).sqrt().max())


def _around(poses: Tensor, index: int) -> Tensor:
    """Return the images (K,) around image `index`, by distance and direction. `poses` are as in `light_spread`."""
    positions, backwards = poses[:, :, 3].double(), poses[:, :, 2].double()
    extent = (positions - positions.mean(0)).norm(dim=-1).median().clamp(min=1e-12)
    turns = torch.acos((backwards @ backwards[index]).clamp(-1, 1))
    apart = (positions - positions[index]).norm(dim=-1) / extent + turns
    apart[index] = torch.inf
    return apart.argsort()[: min(max(len(poses) // AROUND, MIN_AROUND), len(poses) - 1)]

"""How much light, exposure and white balance differ between the photographs of a scene.

A photograph that shows other things has other colours, in the same light. But where the light changes, dark and bright
parts change together. So a photograph is described by its quantiles, and the share of their change that all have in
common is taken for the light's.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

GRID = 4096
"""At most so many pixels of a photograph are looked at."""
QUANTILES = (10, 25, 50, 75, 90)
"""Per cent."""
FEWEST = 64
"""Pixels, below which a photograph is left out."""
APPEARANCE_STOPS = 0.13
"""From here on the light is said to vary. Of seven captures, five in steady light were at 0.02 to 0.09; one whose
lights were dimmed was at 0.20, and one gathered from many cameras and days at 0.29."""
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def light_of(image: np.ndarray, kept: np.ndarray | None = None) -> np.ndarray:
    """A photograph's light, float32 (3, Q): quantiles of log2 of luminance, of red over green and of blue over green.

    Args:
        image: (H, W, 3 or 4) uint8; pixels that are not opaque are left out.
        kept: (H, W) bool, which pixels to look at; all if None.
    Returns: stops; NaN where too little is left.
    """
    step = max(int(np.ceil(np.sqrt(image.shape[0] * image.shape[1] / GRID))), 1)
    seen = image[step // 2 :: step, step // 2 :: step].reshape(-1, image.shape[2])
    use = np.ones(len(seen), bool) if kept is None else kept[step // 2 :: step, step // 2 :: step].reshape(-1)
    if image.shape[2] == 4:
        use = use & (seen[:, 3] == 255)
    if use.sum() < FEWEST:
        return np.full((3, len(QUANTILES)), np.nan, np.float32)
    stored = seen[use, :3] / 255
    linear = np.where(stored <= 0.04045, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4)
    # What is added keeps black from deciding: the ninth stop below white, and a hundredth for colours, which are noise
    # in the dark.
    light = np.log2(linear @ _LUMINANCE + 2**-9)
    red, blue = (np.log2((linear[:, c] + 0.01) / (linear[:, 1] + 0.01)) for c in (0, 2))
    return np.stack([np.percentile(values, QUANTILES) for values in (light, red, blue)]).astype(np.float32)


def light_spread(light: Tensor) -> float:
    """By how many stops the light differs between M photographs, from `light_of` of each (M, 3, Q).

    Of a photograph's quantiles' differences to their medians over all photographs, the smallest counts where all have
    the same sign, and nothing where they do not. Its root mean square over the photographs is that of luminance and of
    both colour ratios; the largest of the three is returned.
    """
    light = light[torch.isfinite(light).all(-1).all(-1)].double()
    if len(light) < 2:
        return 0.0
    change = light - light.quantile(0.5, dim=0)
    together = (change.sign() == change[..., :1].sign()).all(-1)
    shift = torch.where(together, change.abs().amin(-1), 0.0)
    return float(shift.square().mean(0).sqrt().max())

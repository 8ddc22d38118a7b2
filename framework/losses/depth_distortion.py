"""Distortion of a drawn image, the spread of weights along rays: 2D Gaussian Splatting (Huang et al. 2024), section 5.

The authors' code sums squared differences over the pairs of Gaussians in a pixel. With weights w and places m along the
ray,

    sum_{i < j} w_i w_j (m_i - m_j)^2 = (sum_i w_i) (sum_i w_i m_i^2) - (sum_i w_i m_i)^2

so the sums of a blended image suffice.
"""

from __future__ import annotations

from torch import Tensor


def image_distortion(moments: Tensor, transmittance: Tensor, kept: Tensor | None = None) -> Tensor:
    """Return the mean distortion () of pixels; 0 if none is kept.

    Args:
        moments: (H, W, 2) sums of weight times m, and of weight times m^2. An m that is the same for all Gaussians of a
            pixel changes nothing.
        transmittance: (H, W), 1 minus the sum of the weights.
        kept: (H, W) bool, pixels that count; None for all.
    """
    first, second = moments.unbind(-1)
    apart = (1 - transmittance) * second - first.square()
    if kept is None:
        return apart.mean()
    return (apart * kept).sum() / kept.sum().clamp(min=1)

"""Tone curves of cameras, and the exposure and white balance of their images.

Image i of camera k stores the scene's colour c, which is a display colour as well, in each channel as

    g_k(encode(2^e_i decode(c)))

with the transfer function of sRGB, `encode`, and its inverse, `decode`. The exposure e_i is in stops, and white balance
adds to it for red and blue. The curve g_k is monotone. This is the model of Debevec and Malik, "Recovering High Dynamic
Range Radiance Maps from Photographs", SIGGRAPH 1997, equation 1, with a curve relative to sRGB's.
"""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.kernels.color import to_linear, to_srgb

INTERVALS, REACH = 12, 1.5
"""Number of intervals of a curve, of equal lengths, and the display colour where the last one begins to go on forever.
Eight of them are up to white; the others let bright parts of a scene saturate."""


def exposed(colors: Tensor, stops: Tensor) -> Tensor:
    """Return display colours in another exposure, unclipped.

    Args:
        colors: (N, 3) display colours, at least 0.
        stops: (N or 1, 3) exposure of each channel, stops.
    """
    return to_srgb(to_linear(colors) * torch.exp2(stops))


def tone_curve(values: Tensor, log_slopes: Tensor) -> Tensor:
    """Return values of monotone curves, piecewise linear, with a slope of exp(log_slopes) in each interval.

    A curve is 0 at 0. Its first and its last slope go on beyond the intervals.

    Args:
        values: (N, C) positions on the curves.
        log_slopes: (N or 1, K) logarithms of the slopes; with zeros, values stay as they are.
    """
    slopes, length = log_slopes.exp(), REACH / log_slopes.shape[1]
    starts = length * (slopes.cumsum(-1) - slopes)
    before = (values.detach() / length).floor().clamp(0, slopes.shape[1] - 1)
    interval = before.nan_to_num(0.0).long()  # a value that is NaN stays NaN below
    start, slope = (of_curve.expand(len(values), -1).gather(1, interval) for of_curve in (starts, slopes))
    return start + slope * (values - length * before)

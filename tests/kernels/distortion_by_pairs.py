"""The distortion loss by its definition."""

import torch
from torch import Tensor

from nerfloom.geometry.rays import Samples


def distortion_by_pairs(weights: Tensor, samples: Samples) -> Tensor:
    """Compute `distortion` of `weights` and `samples` over all pairs of samples of a ray, by its definition."""
    middles, losses = (samples.t_starts + samples.t_ends) / 2, []
    for start, end in zip(samples.offsets[:-1].tolist(), samples.offsets[1:].tolist(), strict=True):
        w, m, delta = weights[start:end], middles[start:end], samples.deltas[start:end]
        pairs = (w[:, None] * w * (m[:, None] - m).abs()).sum()
        losses.append(pairs + (w * w * delta).sum() / 3)
    return torch.stack(losses) if losses else weights.sum()[None][:0]

"""Gaussians whose places are known."""

import torch
from torch import Tensor

from nerfloom.edit.edited import Edited
from nerfloom.splats.gaussians import Gaussians


def at(means: Tensor, size: float = 0.01, logit: float = 4.0, terms: int = 0, seed: int = 0) -> Gaussians:
    """Round Gaussians at positions (N, 3), with random rotations, colours and harmonics."""
    random, count = torch.Generator().manual_seed(seed), len(means)

    def normal(*shape: int) -> Tensor:
        return torch.randn(count, *shape, generator=random)

    scales, logits = torch.full((count, 3), size).log(), torch.full((count,), logit)
    return Gaussians(means.double(), scales, normal(4), logits, normal(3), 0.2 * normal(3, terms))


def scattered(count: int = 200, seed: int = 0, terms: int = 0) -> Edited:
    """Gaussians with standard normal positions."""
    means = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return Edited(at(means, terms=terms, seed=seed))

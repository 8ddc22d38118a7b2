"""Gaussians at known places."""

import math
from pathlib import Path

import torch
from torch import Tensor

from nerfloom.edit.edited import Edited
from nerfloom.splats.files import write_gaussians
from nerfloom.splats.gaussians import Gaussians
from nerfloom.training.load import load
from tests.dataparsers.captures import POINTS, poses, write_capture


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


def ball_in_capture(folder: Path) -> Edited:
    """An opaque ball in the middle of a capture, a faint Gaussian on it, and the last one in front of it."""
    data = write_capture(folder / "capture")
    middle = torch.from_numpy(POINTS.mean(0))
    index = torch.arange(900, dtype=torch.float64) + 0.5
    z, angle = 1 - 2 * index / 900, index * math.pi * (3 - math.sqrt(5))
    around = (1 - z.square()).sqrt()
    unit = torch.stack([around * angle.cos(), around * angle.sin(), z], -1)
    towards = torch.from_numpy(poses()[4, :3, 3]) - middle
    towards = towards / towards.norm()
    given = at(torch.cat([middle + 0.5 * unit, (middle + 0.5 * towards)[None], (middle + 0.9 * towards)[None]]), 0.05)
    given.logits[-2:] = math.log(0.2 / 0.8)
    write_gaussians(folder / "ball.ply", given.map(torch.Tensor.float))
    return Edited.of(load(folder / "ball.ply", data=data))

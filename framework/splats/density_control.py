"""Growth by gradients: Gaussians are cloned and split where images ask most for it, and transparent ones are dropped.

Kerbl et al. 2023, section 5.2, by the absolute gradients of image positions (AbsGS, Ye et al. 2024), which do not
cancel where the pixels of one Gaussian pull in different directions.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from nerfloom.base.processes import add_up
from nerfloom.kernels.splats.blend import ABSOLUTE_X, ABSOLUTE_Y
from nerfloom.kernels.splats.project import OPACITY, rotation_matrices
from nerfloom.splats.gaussians import Gaussians

GRADIENT = 8e-4
"""Mean gradient of the image position, of images whose longer side is 2 units, from which a Gaussian is not enough."""
LARGE = 0.01
"""Largest standard deviation, in scene extents, of a Gaussian that is cloned; a larger one is split."""
TRANSPARENT = 0.005
"""Opacity below which a Gaussian is dropped."""
CHILDREN, SHRUNK = 2, 1.6
"""Gaussians that one is split into, and the ratio of its standard deviations to theirs."""
RESET = 0.01
"""Opacity to which all are lowered now and then, so that those which nothing needs stay transparent."""


class Growth(NamedTuple):
    """Gaussians that stay, and those that are added."""

    kept: Tensor
    """(K,) int64 which of them stay as they are."""
    fresh: Gaussians
    """Those that are added behind them."""


class GradientMean(nn.Module):
    """The mean size of the gradients of image positions, over the images that show a Gaussian."""

    sums: Tensor
    """(N, 2) sum of the sizes, and number of images; empty before the first."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("sums", torch.zeros(0, 2))

    def add(self, records: Tensor | None, longer_side: int, finite: bool | Tensor = True) -> None:
        """Add an image; without effect if there is none, or it has no gradient.

        Args:
            records: (N, RECORD) Gaussians on the image, which retain their gradient.
            longer_side: of the image, pixels.
            finite: whether the step counts, possibly () bool on the device, where nothing is added if it does not.
        """
        if records is None or records.grad is None:
            return
        if len(self.sums) != len(records):
            self.sums = records.new_zeros(len(records), 2)
        sizes, shown = image_gradients(records.grad, longer_side), records[:, OPACITY] > 0
        if isinstance(finite, Tensor):
            sizes, shown = torch.where(finite, sizes, 0), shown & finite
        self.sums[:, 0] += sizes
        self.sums[:, 1] += shown

    def take(self, count: int) -> Tensor:
        """Return the means (count,) over the images of all processes, 0 of what none has shown, and begin anew.

        Args:
            count: number of Gaussians.
        """
        sums = add_up(self.sums if len(self.sums) == count else self.sums.new_zeros(count, 2))
        self.sums = self.sums.new_zeros(0, 2)
        return sums[:, 0] / sums[:, 1].clamp(min=1)

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: object) -> None:
        saved = state_dict.get(prefix + "sums")
        if saved is not None and saved.ndim == 2 and saved.shape[1] == 2:
            self.sums = self.sums.new_zeros(saved.shape)
        super()._load_from_state_dict(state_dict, prefix, *rest)


def image_gradients(gradient: Tensor, longer_side: int) -> Tensor:
    """Return how much the pixels pull at each Gaussian's position, (N,), on an image whose longer side is 2 units.

    Args:
        gradient: (N, RECORD) their gradient; two columns hold `blend`'s sums of absolute gradients over pixels.
        longer_side: of the image, pixels.
    """
    return torch.hypot(gradient[:, ABSOLUTE_X], gradient[:, ABSOLUTE_Y]) * (longer_side / 2)


def grown(gaussians: Gaussians, gradients: Tensor, most: int, extent: float) -> Growth | None:
    """Clone or split the Gaussians with the largest gradients, and drop transparent ones and those that are not finite.

    Args:
        gaussians: N Gaussians.
        gradients: (N,) mean gradient of their image positions, as `image_gradients` returns them.
        most: maximum number of Gaussians afterwards.
        extent: the scene's, scene units.

    Returns:
        What becomes of them; None if all stay as they are.
    """
    alive = (torch.sigmoid(gaussians.logits) > TRANSPARENT) & gaussians.finite()
    wanting = alive & (gradients > GRADIENT)
    room = max(most - int(alive.sum()), 0)
    if int(wanting.sum()) > room:
        chosen = torch.where(wanting, gradients, -1).topk(room).indices
        wanting = torch.zeros_like(wanting).index_fill_(0, chosen, True) & wanting
    large = gaussians.log_scales.exp().amax(-1) > LARGE * extent
    split, cloned = wanting & large, wanting & ~large
    kept = (alive & ~split).nonzero()[:, 0]
    if len(kept) == len(gaussians) and not bool(cloned.any()):
        return None
    children = [_child(gaussians[split]) for _ in range(CHILDREN)]
    return Growth(kept, _joined([gaussians[cloned], *children]))


def _child(gaussians: Gaussians) -> Gaussians:
    """Return a smaller Gaussian at a random place of each."""
    g = gaussians
    offset = torch.randn_like(g.means) * g.log_scales.exp()
    means = g.means + (rotation_matrices(g.rotations) @ offset[:, :, None])[:, :, 0]
    shrunk = g.log_scales - torch.tensor(SHRUNK).log().to(g.log_scales)
    return Gaussians(means, shrunk, g.rotations, g.logits, g.colors, g.harmonics)


def _joined(parts: list[Gaussians]) -> Gaussians:
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    return Gaussians(*(torch.cat(column) for column in columns))

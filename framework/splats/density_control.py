"""Adaptive density control: Gaussians with large gradients are cloned or split, and transparent ones are dropped.

Source: Kerbl et al. 2023, section 5.2, with the absolute gradients of image positions (AbsGS, Ye et al. 2024). These do
not cancel where the pixels of a Gaussian have opposite gradients.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor, nn

from nerfloom.base.processes import add_up
from nerfloom.kernels.splats.blend import ABSOLUTE_X, ABSOLUTE_Y
from nerfloom.kernels.splats.project import Record, SplatCamera, rotation_matrices
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.strategy import Change, Rows, Strategy

GRADIENT = 8e-4
"""Gaussians with a larger mean gradient of the image position are cloned or split; images have a longer side of 2
units."""
MAX_CLONED_SIZE = 0.01
"""Largest standard deviation, in scene extents, of a Gaussian that is cloned; a larger one is split."""
MAX_DEAD_OPACITY = 0.02
"""Gaussians at or below this opacity are dropped. 3DGS has a quarter of it: such Gaussians take as much of each step as
others, for hardly any light."""
CHILDREN, SHRUNK = 2, 1.6
"""Number of Gaussians that replace a split one, and the divisor of its standard deviations."""
MAX_RESET_OPACITY = 0.04
"""Maximum opacity after a reset, twice `MAX_DEAD_OPACITY` as in 3DGS. Gaussians that no image needs stay transparent
and are dropped."""


class GradientMean(nn.Module):
    """The mean size of the gradients of image positions, over the images that show a Gaussian.

    Call `watch` before the backward pass of an image, and `add` after it.
    """

    sums: Tensor
    """(N, 2) sum of the sizes, and number of images; empty before the first."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("sums", torch.zeros(0, 2))
        self._watched: tuple[Tensor, list[Tensor]] | None = None  # records, and their gradient after the backward pass
        self._longer_side = 1
        self._rows: Rows | None = None

    def watch(self, records: Tensor, camera: SplatCamera, rows: Rows | None = None) -> None:
        """Keep the gradient of an image's records; does nothing if they require none.

        Args:
            records: (N, RECORD) Gaussians on the image; (K, RECORD) with `rows`.
            camera: of the image.
            rows: the Gaussians that `records` are of; None for all.
        """
        if records.requires_grad:
            gradients: list[Tensor] = []
            records.register_hook(gradients.append)  # `retain_grad` would copy them
            self._watched, self._longer_side = (records.detach(), gradients), max(camera.width, camera.height)
            self._rows = rows

    @torch.no_grad()
    def add(self, finite: bool | Tensor = True) -> None:
        """Add the gradient of the image watched last; does nothing if there is none.

        Args:
            finite: whether the step counts, possibly () bool on the device; nothing is added if it does not.
        """
        watched, self._watched = self._watched, None
        if watched is None or not watched[1]:
            return
        records, gradient, rows = watched[0], watched[1][-1], self._rows
        index: Tensor | slice = slice(None) if rows is None else rows.indices
        count = len(records) if rows is None else rows.total
        if len(self.sums) != count:
            self.sums = records.new_zeros(count, 2)
        sizes, shown = image_gradients(gradient, self._longer_side), records[:, Record.OPACITY] > 0
        if isinstance(finite, Tensor):
            sizes, shown = torch.where(finite, sizes, 0), shown & finite
        self.sums[index, 0] += sizes
        self.sums[index, 1] += shown

    def take(self, count: int) -> Tensor:
        """Return the means (count,) over the images of all processes, and reset them. Gaussians in no image have 0.

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


class DensityControl(Strategy):
    """Adaptive density control of 3D Gaussian Splatting.

    Args:
        steps_per_reset: steps between resets that make all Gaussians nearly transparent.
    """

    def __init__(self, steps_per_reset: int) -> None:
        super().__init__()
        self.steps_per_reset, self.gradients = steps_per_reset, GradientMean()
        self._last_step: int | None = None

    def watch(self, records: Tensor, camera: SplatCamera, rows: Rows | None = None) -> None:
        self.gradients.watch(records, camera, rows)

    def after_every_step(self, finite: bool | Tensor) -> None:
        self.gradients.add(finite)

    def reset(self, gaussians: Gaussians, step: int) -> dict[str, Tensor]:
        last, self._last_step = step - 1 if self._last_step is None else self._last_step, step
        if (step + 1) // self.steps_per_reset == (last + 1) // self.steps_per_reset:
            return {}
        self.gradients.take(len(gaussians))
        return {"logits": gaussians.logits.clamp(max=math.log(MAX_RESET_OPACITY / (1 - MAX_RESET_OPACITY)))}

    def grow(self, gaussians: Gaussians, most: int, extent: float) -> Change | None:
        return grown(gaussians, self.gradients.take(len(gaussians)), most, extent)


def image_gradients(gradient: Tensor, longer_side: int) -> Tensor:
    """Return the absolute gradient (N,) of each Gaussian's image position, for an image with a longer side of 2 units.

    Args:
        gradient: (N, RECORD) gradient of the records; two columns hold `blend`'s sums of absolute gradients over
            pixels.
        longer_side: longer side of the image, pixels.
    """
    return torch.hypot(gradient[:, ABSOLUTE_X], gradient[:, ABSOLUTE_Y]) * (longer_side / 2)


def grown(gaussians: Gaussians, gradients: Tensor, most: int, extent: float) -> Change | None:
    """Clone or split Gaussians with large gradients; drop transparent Gaussians and any that are not finite.

    Args:
        gaussians: N Gaussians.
        gradients: (N,) mean gradient of their image positions, as `image_gradients` returns them.
        most: maximum number of Gaussians afterwards.
        extent: size of the scene, scene units.

    Returns:
        The change; None if nothing changes.
    """
    alive = (torch.sigmoid(gaussians.logits) > MAX_DEAD_OPACITY) & gaussians.finite()
    wanting = alive & (gradients > GRADIENT)
    left = max(most - int(alive.sum()), 0)
    if int(wanting.sum()) > left:
        chosen = torch.where(wanting, gradients, -1).topk(left).indices
        wanting = torch.zeros_like(wanting).index_fill_(0, chosen, True) & wanting
    large = gaussians.log_scales.exp().amax(-1) > MAX_CLONED_SIZE * extent
    split, cloned = wanting & large, wanting & ~large
    kept = (alive & ~split).nonzero()[:, 0]
    if len(kept) == len(gaussians) and not bool(cloned.any()):
        return None
    children = [_child(gaussians[split]) for _ in range(CHILDREN)]
    return Change(kept, Gaussians.joined([gaussians[cloned], *children]))


def _child(gaussians: Gaussians) -> Gaussians:
    """Return a smaller Gaussian at a random position inside each Gaussian."""
    g = gaussians
    offset = torch.randn_like(g.means) * g.log_scales.exp()
    means = g.means + (rotation_matrices(g.rotations) @ offset[:, :, None])[:, :, 0]
    shrunk = g.log_scales - torch.tensor(SHRUNK).log().to(g.log_scales)
    return replace(g, means=means, log_scales=shrunk)

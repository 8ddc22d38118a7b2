"""The interface of strategies: how the Gaussians of a model come and go while it learns."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

from torch import Tensor, nn

from nerfloom.kernels.splats.project import SplatCamera
from nerfloom.splats.gaussians import Gaussians


class Change(NamedTuple):
    """Gaussians that stay, and those that are added behind them."""

    kept: Tensor
    """(K,) int64 which of them stay as they are."""
    fresh: Gaussians
    """Those that are added, with new optimiser state."""


class Strategy(nn.Module, ABC):
    """A way in which Gaussians come and go.

    Its buffers are a part of checkpoints.
    """

    changes_per_doubling: ClassVar[float] = 5.0
    """About how many changes double the number of Gaussians: growth by gradients was seen to need 4.5 to 6."""

    def watch(self, records: Tensor, camera: SplatCamera) -> None:
        """See a training image before its backward pass, as to keep the gradient of what it shows; nothing by default.

        Args:
            records: (N, C) Gaussians on the image, with a graph.
            camera: of the image.
        """

    def after_every_step(self, finite: bool | Tensor) -> None:
        """Do what follows each step, with its gradients in place; nothing by default.

        Args:
            finite: whether the step counts; if this is still on the device, () bool, nothing may change where it is
                False.
        """

    def reset(self, gaussians: Gaussians, step: int) -> dict[str, Tensor]:
        """Return new values of whole columns, whose optimiser state then starts anew; none by default.

        It is asked every few steps (`steps_per_move`), and before `grow`, which is left out if it returns something.

        Args:
            gaussians: all of them.
            step: number of training steps done before this one.

        Returns:
            Values (N, ...) by the column's name.
        """
        return {}

    @abstractmethod
    def grow(self, gaussians: Gaussians, most: int, extent: float) -> Change | None:
        """Return which Gaussians stay, and those that are added; None if nothing changes.

        It is asked every few steps (`steps_per_move`). A Gaussian is moved by adding it elsewhere.

        Args:
            gaussians: all of them, at rest if they move with time.
            most: maximum number of Gaussians afterwards.
            extent: size of the scene, scene units.
        """

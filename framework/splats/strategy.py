"""The interface of strategies, which add and remove Gaussians during training."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

from torch import Tensor, nn

from nerfloom.kernels.splats.project import SplatCamera
from nerfloom.splats.gaussians import Gaussians


class Change(NamedTuple):
    """The Gaussians that stay, and new ones that follow them."""

    kept: Tensor
    """(K,) int64 indices of the Gaussians that stay."""
    fresh: Gaussians
    """New Gaussians, with new optimiser state."""


class Rows(NamedTuple):
    """Some of the Gaussians."""

    indices: Tensor
    """(K,) int64 their indices, ascending."""
    total: int
    """Number N of all Gaussians."""


class Strategy(nn.Module, ABC):
    """A strategy that adds, removes and moves Gaussians.

    Its buffers are saved in checkpoints.
    """

    changes_per_doubling: ClassVar[float] = 5.0
    """Approximate number of changes that double the number of Gaussians; measured for growth by gradients: 4.5 to 6."""

    def watch(self, records: Tensor, camera: SplatCamera, rows: Rows | None = None) -> None:
        """See a training image before its backward pass, to retain gradients for example; nothing by default.

        Args:
            records: (N, C) Gaussians on the image, with a graph; (K, C) with `rows`.
            camera: camera of the image.
            rows: the Gaussians that `records` are of, with a memory limit; None for all.
        """

    def after_every_step(self, finite: bool | Tensor) -> None:
        """Called after each step, with its gradients in place; does nothing by default.

        Args:
            finite: whether the step counts, possibly () bool on the device; if it is False, nothing may change.
        """

    def reset(self, gaussians: Gaussians, step: int) -> dict[str, Tensor]:
        """Return new values of whole columns; their optimiser state is reset. None by default.

        Called every `steps_per_move` steps, before `grow`, which is skipped if this returns values.

        Args:
            gaussians: all N Gaussians.
            step: number of training steps done before this one.

        Returns:
            Values (N, ...) by the column's name.
        """
        return {}

    @abstractmethod
    def grow(self, gaussians: Gaussians, most: int, extent: float) -> Change | None:
        """Return the Gaussians that stay and the new ones; None if nothing changes.

        Called every `steps_per_move` steps. To move a Gaussian, remove it and add it elsewhere.

        Args:
            gaussians: all N Gaussians, at rest if they move with time.
            most: maximum number of Gaussians afterwards.
            extent: size of the scene, scene units.
        """

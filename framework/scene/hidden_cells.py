"""Space that no training ray reaches, found during training: the inside of things, and the ground below a floor.

A ray has samples in occupied cells until hardly any of its light is left. So an occupied cell without samples lies
behind a surface, or beside all images. No image says anything about it.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from nerfloom.base.processes import add_up
from nerfloom.kernels.march.occupancy import Occupancy, dilated

PERIOD = 512
"""Number of training steps over which cells are watched."""
MARGIN = 1
"""Cells this close to a cell with samples, along every axis, count as reached: few rays may pass a cell."""


class HiddenCells(nn.Module):
    """The cells of a box that no training ray has reached in the last whole period; none in the first period.

    Args:
        box: (2, 3) corners of the box, scene units.
        resolution: number n of cells along each axis.
    """

    box: Tensor
    reached: Tensor
    """(n^3 + 1,) bool, cells with samples since the last period; the last entry stands for no cell."""
    hidden: Tensor
    """(n^3,) bool, cells far from any that had samples in the last whole period."""

    def __init__(self, box: Tensor, resolution: int) -> None:
        super().__init__()
        self.resolution = resolution
        none = torch.zeros(resolution**3 + 1, dtype=torch.bool, device=box.device)
        self.register_buffer("box", box.clone(), persistent=False)
        self.register_buffer("reached", none)
        self.register_buffer("hidden", none[:-1].clone())

    def note(self, positions: Tensor, lengths: Tensor) -> None:
        """Note samples of a training step.

        Args:
            positions: (N, 3) scene coordinates, without gradient.
            lengths: (N,) lengths of their intervals; samples of length 0 do not count.
        """
        cells = self._cells(positions).masked_fill(lengths <= 0, len(self.hidden))
        self.reached.index_fill_(0, cells, True)

    def settle(self, step: int) -> None:
        """Begin the next period if one has ended.

        Args:
            step: number of training steps done.
        """
        if step == 0 or step % PERIOD:
            return
        reached = add_up(self.reached[:-1].to(torch.uint8)) > 0
        self.hidden.copy_(~dilated(Occupancy(reached, self.box, self.resolution), MARGIN))
        self.reached.zero_()

    def at(self, positions: Tensor, occupied: Tensor) -> Tensor:
        """Return whether positions are in occupied cells that are hidden, (N,) bool.

        Args:
            positions: (N, 3) scene coordinates.
            occupied: (n^3,) bool, the cells that are sampled now.
        """
        return (self.hidden & occupied).index_select(0, self._cells(positions))

    def _cells(self, positions: Tensor) -> Tensor:
        """Return the index (N,) of the cell of each position."""
        return Occupancy(self.hidden, self.box, self.resolution).cells(positions)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        """Load the cells; a checkpoint without them has none hidden."""
        missing = {prefix + name: getattr(self, name) for name in ("reached", "hidden")}
        super()._load_from_state_dict({**missing, **state_dict}, prefix, *rest)

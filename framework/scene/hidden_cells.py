"""Space that images show but no training ray reaches, found during training: the inside of things, and the ground.

A ray has samples in occupied cells until hardly any of its light is left. So an occupied cell within the frames of the
images that has no samples lies behind a surface. Space beside all frames is not hidden: nothing stands before it. Nor
is space outside the sphere where the rays' samples end: the background shows it.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from nerfloom.base.processes import add_up
from nerfloom.cameras.cameras import Cameras
from nerfloom.geometry.bounds import cell_corners
from nerfloom.kernels.march.occupancy import Occupancy, dilated
from nerfloom.kernels.native import torch_on_one_thread
from nerfloom.scene.covisible_space import times_seen

CELLS = 64
"""Number of cells along each axis of the box."""
PERIOD = 512
"""Number of training steps in a period of observation."""
MARGIN = 1
"""Cells this close to a cell with samples, along every axis, count as reached: few rays may pass a cell."""


class HiddenCells(nn.Module):
    """The cells of a box that images show and no training ray has reached in the last whole period.

    There are none before `show` is called, and none in the first period.

    Args:
        box: (2, 3) corners of the box, scene units.
    """

    box: Tensor
    shown: Tensor
    """(n^3,) bool, cells in the sphere, within the frames of enough images."""
    reached: Tensor
    """(n^3 + 1,) bool, cells with samples since the last period; the last entry stands for no cell."""
    hidden: Tensor
    """(n^3,) bool, shown cells far from any that had samples in the last whole period."""

    def __init__(self, box: Tensor) -> None:
        super().__init__()
        none = torch.zeros(CELLS**3 + 1, dtype=torch.bool, device=box.device)
        self.register_buffer("box", box.clone(), persistent=False)
        self.register_buffer("reached", none)
        self.register_buffer("shown", none[:-1].clone())
        self.register_buffer("hidden", none[:-1].clone())

    @torch.no_grad()
    def show(self, cameras: Cameras, nearest: Tensor, least: int, sphere: Tensor) -> None:
        """Find the cells in the sphere that at least `least` images show, or all images if there are fewer.

        Args:
            cameras, nearest, least: as in `CovisibleSpace.exclude`.
            sphere: (4,) centre and radius of the sphere that has the rays' samples, scene units.
        """
        least, sphere = min(least, len(cameras)), sphere.to(self.box)
        corners = cell_corners(torch.arange(CELLS**3, device=self.box.device), CELLS)
        middles = torch.lerp(self.box[0], self.box[1], (corners + 0.5) / CELLS)
        inside = (middles - sphere[:3]).norm(dim=-1) <= sphere[3]
        with torch_on_one_thread():  # the operations are small
            self.shown.copy_((times_seen(cameras, nearest, self.box, CELLS, least) >= least) & inside)

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
        self.hidden.copy_(self.shown & ~dilated(Occupancy(reached, self.box, CELLS), MARGIN))
        self.reached.zero_()

    def at(self, positions: Tensor) -> Tensor:
        """Return whether `positions` (N, 3), scene coordinates, are in hidden cells, (N,) bool.

        Empty cells have no samples either, so only occupied ones are behind a surface.
        """
        return self.hidden.index_select(0, self._cells(positions))

    def _cells(self, positions: Tensor) -> Tensor:
        """Return the index (N,) of the cell of each position."""
        return Occupancy(self.hidden, self.box, CELLS).cells(positions)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        """Load the cells; a checkpoint without them has none hidden."""
        missing = {prefix + name: getattr(self, name) for name in ("reached", "shown", "hidden")}
        super()._load_from_state_dict({**missing, **state_dict}, prefix, *rest)

"""Skips empty space by an occupancy grid, and what is hidden by marching with an early stop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor, nn

from framework.geometry.rays import Rays, Samples
from framework.samplers.occupancy import OccupancySampler
from nerfloom.functions import DensityOnly, SigmaFunction, as_density, check_rays

FILL_STEPS = 1025
"""Training steps whose updates fill a grid: those that visit all cells, and three times as many beside what is full."""


class OccupancyGrid(nn.Module):
    """Records which cells of a box are not empty: Instant-NGP's grid (Mueller et al. 2022, appendix E.2).

    It has buffers and no parameters: as a part of a model it is saved with it and moves to its device. As long as
    nothing is known of a cell, it is taken for occupied.

    Args:
        box: (2, 3) smallest and largest corner, a tensor or two lists; the grid is on its device.
        resolution: cells along each axis, 512 at most.
        num_steps: steps along the box's diagonal, which says how far apart samples are: see `step_size`.
        alpha_threshold: a cell is occupied where one step through it has at least this opacity, or the grid's mean if
            that is less.
        cone: growth of a step per unit of distance, beyond the distance where it exceeds the even step; 0 for even
            steps throughout.
        moving: the scene changes with time, and its functions take times: a cell is occupied if it is at any time.
    Raises: ConfigError where there are too many cells, or no step; ValueError where the box is none.
    """

    def __init__(
        self,
        box: Tensor | Sequence[Sequence[float]],
        resolution: int = 128,
        num_steps: int = 512,
        *,
        alpha_threshold: float = 0.01,
        cone: float = 0.0,
        moving: bool = False,
    ) -> None:
        super().__init__()
        corners = torch.as_tensor(box, dtype=torch.float32)
        if corners.shape != (2, 3) or not bool((corners[1] > corners[0]).all()):
            raise ValueError(f"a box is its smallest corner and its largest, with no side of 0: not {corners.tolist()}")
        self.marcher = OccupancySampler(
            corners.cpu(), resolution, num_steps, alpha_threshold=alpha_threshold, cone=cone, moving=moving
        ).to(corners.device)

    @property
    def box(self) -> Tensor:
        """(2, 3) smallest and largest corner."""
        return self.marcher.box

    @property
    def step_size(self) -> float:
        """Length of a step near the camera, scene units."""
        return self.marcher.step_size

    @property
    def moving(self) -> bool:
        """Whether functions take times."""
        return self.marcher.moving

    @property
    def occupied(self) -> Tensor:
        """(n, n, n) bool along x, y, z: the cells that are not skipped."""
        return self.marcher.occupied.view(3 * (self.marcher.resolution,))

    def update(self, step: int, sigma_fn: SigmaFunction) -> None:
        """Evaluate the density in some cells and mark anew which are occupied: every 8 steps at first, every 16 later.

        To be called before each training step. By step 256 all cells have been visited, those that are not empty four
        times.

        Args:
            step: number of the training step, from 0.
            sigma_fn: (positions (N, 3)) -> sigma (N,), and of a moving scene (positions, times (N,)); without a
                gradient.
        Raises: ValueError where `sigma_fn` returns another shape.
        """
        self.marcher.update(step, as_density(sigma_fn))

    def fill(self, sigma_fn: SigmaFunction) -> None:
        """Evaluate the density in all cells, for a field that has been trained already.

        Args:
            sigma_fn: as for `update`.
        Raises: ValueError where `sigma_fn` returns another shape.
        """
        for step in range(FILL_STEPS):
            self.update(step, sigma_fn)

    def carve(self, kept: Tensor) -> None:
        """Mark cells as empty for good, whatever updates say of them.

        Args:
            kept: (n, n, n) bool along x, y, z; False where a cell is empty.
        """
        self.marcher.carve(kept.reshape(-1).to(self.marcher.occupied.device))


def sample(
    rays: Rays,
    sigma_fn: SigmaFunction | None,
    grid: OccupancyGrid,
    *,
    early_stop: float = 1e-4,
    jitter: bool = False,
) -> Samples:
    """Sample rays in occupied cells, as far as light gets.

    Rays are marched in waves, from near to far; a ray whose transmittance has fallen below `early_stop` is not followed
    any further. What is behind could have changed a colour channel in [0, 1] by at most `early_stop`. For what the
    grid skips no bound is stated: a cell is judged by a few positions in it.

    Args:
        rays: R rays; where near and far ends are not given, those of the grid's box. Samples have no gradient to rays.
        sigma_fn: (positions (N, 3)) -> sigma (N,), and of a moving scene (positions, times (N,)); asked without a
            gradient, and for nothing but where to stop. None skips empty cells alone.
        grid: what is occupied.
        early_stop: transmittance below which the rest of a ray is dropped; 0 for never. While training, 1e-2 is as good
            a teacher as 1e-4, and faster.
        jitter: each ray's steps begin at a random share of one (training); else at 0 (evaluation).
    Returns: packed samples of R rays, ray by ray and from near to far.
    Raises: ValueError where rays are of another shape or length, rays or the grid alone know of times, or `sigma_fn`
        returns another shape.
    """
    check_rays(rays)
    if rays.times is None and grid.moving:
        raise ValueError("the grid is of a moving scene, but the rays have no times")
    if rays.times is not None and not grid.moving:
        raise ValueError("the rays have times, but the grid is of a still scene: OccupancyGrid(..., moving=True)")
    with torch.no_grad():
        stop = 0.0 if sigma_fn is None else early_stop
        samples = grid.marcher.sample(rays, DensityOnly(sigma_fn), jitter, stop)
    return replace(samples, sigma=None, features=None)

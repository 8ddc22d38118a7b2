"""Sampling with an occupancy grid, which skips empty space, and an early stop, which skips hidden space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor, nn

from nerfloom.geometry.rays import Rays, Samples
from nerfloom.plug_and_play.functions import DensityOnly, SigmaFunction, as_density, check_rays
from nerfloom.samplers.occupancy import OccupancySampler

FILL_STEPS = 1025
"""Number of steps of `OccupancyGrid.fill`: enough to visit all cells, then three times as many to evaluate cells near
occupied ones."""


class OccupancyGrid(nn.Module):
    """The occupied cells of a box: Instant-NGP (Mueller et al. 2022), appendix E.2.

    The state is in buffers, without parameters: as a part of a model it is saved with the model and moves to its
    device. A cell counts as occupied until its density has been evaluated.

    Args:
        box: (2, 3) minimum and maximum corner, a tensor or two lists; the grid is on the tensor's device.
        resolution: cells along each axis, at most 512.
        num_steps: steps along the diagonal of the box, which determine `step_size`.
        alpha_threshold: a cell is occupied if the opacity of one step through it reaches this threshold or the mean
            over the grid, whichever is less.
        cone: growth of the step per unit of distance, once this exceeds the even step; 0 for even steps throughout.
        moving: whether the scene changes with time, so that its functions take times. A cell then counts as occupied if
            it is so at any time.

    Raises:
        ConfigError: if there are too many cells, or no steps.
        ValueError: if the box has another shape, or an edge that is not positive.
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
            raise ValueError(f"a box is a minimum and a maximum corner, with positive sides, not {corners.tolist()}")
        self.marcher = OccupancySampler(
            corners.cpu(), resolution, num_steps, alpha_threshold=alpha_threshold, cone=cone, moving=moving
        ).to(corners.device)

    @property
    def box(self) -> Tensor:
        """(2, 3) minimum and maximum corner."""
        return self.marcher.box

    @property
    def step_size(self) -> float:
        """Length of a step near the camera, in the unit of the box."""
        return self.marcher.step_size

    @property
    def moving(self) -> bool:
        """True if the scene changes with time, so that functions take times."""
        return self.marcher.moving

    @property
    def occupied(self) -> Tensor:
        """(n, n, n) bool along x, y, z, True for cells that are sampled."""
        return self.marcher.occupied.view(3 * (self.marcher.resolution,))

    def update(self, step: int, sigma_fn: SigmaFunction) -> None:
        """Evaluate the density in some cells and update `occupied`, every 8 steps at first and every 16 later.

        Call it before each training step. Every cell has been evaluated by step 256, and occupied cells four times.

        Args:
            step: number of the training step, from 0.
            sigma_fn: density (positions (N, 3)) -> sigma (N,), or (positions, times (N,)) -> sigma (N,) if `moving`;
                called without gradient.

        Raises:
            ValueError: if `sigma_fn` returns another shape.
        """
        self.marcher.update(step, as_density(sigma_fn))

    def fill(self, sigma_fn: SigmaFunction) -> None:
        """Evaluate the density in all cells, for a field that is already trained.

        Args:
            sigma_fn: density, as in `update`.

        Raises:
            ValueError: if `sigma_fn` returns another shape.
        """
        for step in range(FILL_STEPS):
            self.update(step, sigma_fn)

    def carve(self, kept: Tensor) -> None:
        """Mark cells outside `kept` (n, n, n) bool along x, y, z as empty, permanently."""
        self.marcher.carve(kept.reshape(-1).to(self.marcher.occupied.device))


def sample(
    rays: Rays, sigma_fn: SigmaFunction | None, grid: OccupancyGrid, *, early_stop: float = 1e-4, jitter: bool = False
) -> Samples:
    """Return samples of rays in occupied cells, up to an early stop.

    Rays are marched in waves, from near to far, until their transmittance is below `early_stop`. The dropped samples
    change a colour channel in [0, 1] by at most `early_stop`. The error from cells that the grid skips has no such
    bound, because a cell is classified by its density at a few positions.

    Args:
        rays: R rays; without near and far ends, the grid's box sets them. Samples have no gradient for rays.
        sigma_fn: density (positions (N, 3)) -> sigma (N,), or (positions, times (N,)) -> sigma (N,) for a moving scene.
            It is called without gradient, only to find the end of each ray. None for no early stop.
        grid: the occupied cells.
        early_stop: transmittance below which the rest of a ray is dropped; 0 for never. In training, 1e-2 gives the
            same quality as 1e-4 and is faster.
        jitter: True to start each ray at a random fraction of a step (training), False to start at 0 (evaluation).

    Returns:
        Packed samples, ray by ray, and from near to far on each ray.

    Raises:
        ValueError: if the rays have a wrong shape or length of directions, if only the rays or only the grid has times,
            or if `sigma_fn` returns another shape.
    """
    check_rays(rays)
    if rays.times is None and grid.moving:
        raise ValueError("the grid is of a moving scene, but the rays have no times")
    if rays.times is not None and not grid.moving:
        raise ValueError("the rays have times, but the grid is of a static scene: use OccupancyGrid(..., moving=True)")
    with torch.no_grad():
        stop = 0.0 if sigma_fn is None else early_stop
        samples = grid.marcher.sample(rays, DensityOnly(sigma_fn), jitter, stop)
    return replace(samples, sigma=None, features=None)

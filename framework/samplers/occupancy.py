"""Skip empty space with an occupancy grid, and what is hidden by marching in waves.

The grid is Instant-NGP's (Mueller et al. 2022, appendix E.2): a moving maximum of the density in each cell, a cell
being skipped while a step through it would be nearly transparent.
"""

from __future__ import annotations

import math
from functools import partial

import torch
from torch import Tensor

from framework.base.errors import ConfigError, shown
from framework.fields.base import DensityFunction, Field, HasAlpha
from framework.geometry.points import Points, interval_points
from framework.geometry.rays import Rays, Samples
from framework.kernels.alpha import alpha_depth
from framework.kernels.given import is_followed
from framework.kernels.kept import Waves
from framework.kernels.march import Occupancy, Wave, march, refresh_occupancy
from framework.kernels.rows import gather_rows
from framework.samplers.base import Sampler

MAX_CELLS = 512
"""Along an axis of the grid: of 512^3 cells what is known takes 0.8 GB."""
CHUNK = 2**15
"""Cells evaluated at once."""
WARM_UP_STEPS = 256
"""Steps during which the grid is visited in a fixed shuffle."""
WARM_UP_DECAY, DECAY = 0.7, 0.8
"""Of a cell's density at each visit, in the beginning and afterwards."""
TIMES_PER_VISIT, MOVING_DECAY = 4, 0.95
"""Of a scene that moves: times at which a cell is looked at, and its decay, for it may be full for a short while."""
SHUFFLE_STRIDE = 2654435761
"""A prime, so that its multiples visit every cell once a pass, far from one another."""
WAVES = (8, 8, 16, 32, 64, 128)
"""Samples a ray in each wave; the last size repeats."""


class OccupancySampler(Sampler):
    """March through the occupied cells of a box.

    Args:
        box: (2, 3) corners of the space that is marched.
        resolution: cells along each axis.
        num_steps: steps along the box's diagonal.
        early_stop: transmittance below which the rest of a ray is dropped: the most that any colour channel can be
            off by. 0 keeps everything.
        train_early_stop: the same while training, where less exact colours teach as well; `early_stop` if None.
        alpha_threshold: a cell is occupied where one step through it has at least this opacity, or the grid's mean
            if that is less.
        cone: growth of a step per unit of distance, beyond the distance where it exceeds the even step; 0 for even
            steps throughout.
        moving: the scene changes with time: a cell is occupied if it is at any time.
    """

    box: Tensor
    density_grid: Tensor
    occupied: Tensor
    carved: Tensor

    def __init__(
        self,
        box: Tensor,
        resolution: int = 128,
        num_steps: int = 512,
        early_stop: float = 1e-4,
        train_early_stop: float | None = None,
        alpha_threshold: float = 0.01,
        cone: float = 0.0,
        moving: bool = False,
    ) -> None:
        super().__init__()
        if not 1 <= resolution <= MAX_CELLS or not num_steps >= 1:
            raise ConfigError(
                f"an occupancy grid has 1 to {MAX_CELLS} cells along an axis and 1 step or more, "
                f"not {shown(resolution)} and {shown(num_steps)}"
            )
        self.resolution = resolution
        self.step_size = (box[1] - box[0]).norm().item() / num_steps
        self.early_stop = early_stop
        self.train_early_stop = early_stop if train_early_stop is None else train_early_stop
        self.alpha_threshold = alpha_threshold
        self.cone = cone
        self.moving = moving
        self.register_buffer("box", box.clone())
        self.register_buffer("density_grid", torch.full((resolution**3,), torch.inf))
        self.register_buffer("occupied", torch.ones(resolution**3, dtype=torch.bool))
        self.register_buffer("carved", torch.zeros(resolution**3, dtype=torch.bool))
        self._packed: Occupancy | None = None
        self.register_load_state_dict_post_hook(lambda module, _: module.forget())

    @property
    def occupied_share(self) -> float:
        """Share of cells that are not skipped."""
        return self.occupied.float().mean().item()

    @property
    def any_carved(self) -> bool:
        """Whether silhouettes have emptied cells for good."""
        return bool(self.carved.any())

    @property
    def occupancy(self) -> Occupancy:
        """The grid as marching wants it."""
        if self._packed is None or self._packed.occupied is not self.occupied:
            self._packed = Occupancy(self.occupied, self.box, self.resolution)
        return self._packed

    def forget(self) -> None:
        """`occupied` has changed: pack it anew when it is asked for."""
        self._packed = None

    # -- sampling ---------------------------------------------------------------------------------------------

    def sample(self, rays: Rays, field: Field, jitter: bool, early_stop: float | None = None) -> Samples:
        """Samples in occupied cells, as far as light gets; densities and features attached.

        What is dropped could have changed a colour channel by at most `early_stop`: what is given here, or the
        sampler's own, `train_early_stop` while training.

        Raises: ValueError where the rays ask for a gradient, which marched samples do not carry.
        """
        if is_followed(rays.origins, rays.directions):
            raise ValueError("marched samples carry no gradient to rays: detach these, or take a ProposalSampler")
        shift = torch.rand(len(rays), device=rays.origins.device) if jitter else None
        own = self.train_early_stop if self.training else self.early_stop
        stop = own if early_stop is None else early_stop
        marched = march(rays, self.occupancy, self.step_size, self.cone, shift, stop)

        def evaluate(wave: Wave) -> tuple[Tensor, Tensor]:
            points = interval_points(rays, wave.owners, wave, wave.positions, field.footprint)
            if surface is None:
                return field.density(points)
            return surface.alpha(points, rays.directions.index_select(0, wave.owners), wave.t_ends - wave.t_starts)

        surface = field if isinstance(field, HasAlpha) else None
        evaluated = Waves()
        while (wave := marched.wave(WAVES[min(len(marched.waves), len(WAVES) - 1)])) is not None:
            stopping = evaluated.evaluate(len(wave.owners), partial(evaluate, wave))[0]
            if surface is not None:  # marched by the density that stops as much light in each interval
                stopping = alpha_depth(stopping.detach()) / (wave.t_ends - wave.t_starts)
            marched.advance(stopping)
        order, offsets = marched.finish()
        if not marched.waves:  # no ray meets anything: still the field's own, empty, tensors
            empty = rays.nears[:0]
            samples = Samples(empty, empty, offsets, owners=order, early_stop=stop)
            return _attached(samples, surface, *evaluate(Wave(empty, empty, order, rays.origins[:0])))
        waves = marched.waves
        columns = [[w.t_starts for w in waves], [w.t_ends for w in waves], [w.owners for w in waves]]
        starts, ends, owners = gather_rows(columns, order)

        def chosen() -> tuple[Tensor, Tensor]:
            (positions,) = gather_rows([[w.positions for w in waves]], order)
            return evaluate(Wave(starts, ends, owners, positions))

        samples = Samples(starts, ends, offsets, owners=owners, early_stop=stop)
        return _attached(samples, surface, *evaluated.choose(order, chosen))

    # -- keeping the grid up ----------------------------------------------------------------------------------

    def carve(self, hull: Tensor) -> None:
        """Cells outside `hull` (n^3,) are known to be empty (`framework.scene.silhouettes`), and stay so for good."""
        self.carved.copy_(~hull)
        self.density_grid.masked_fill_(self.carved, 0)
        self.occupied.logical_and_(hull)
        self.forget()

    @torch.no_grad()
    def update(self, step: int, density: DensityFunction) -> None:
        """Evaluate some cells and mark anew which are occupied: every 8 steps at first, every 16 later.

        At first the cells come in the order of a fixed shuffle, so that each is seen soon; afterwards they are drawn
        among all cells, so that an emptied one can fill again, among the occupied ones, and among those beside them.
        """
        warming_up = step < WARM_UP_STEPS
        if step == 0 or step % (8 if warming_up else 16):
            return
        cells = self._shuffled(step // 8 - 1) if warming_up else self._drawn()
        n = self.resolution
        corner = torch.stack([cells // n**2, cells // n % n, cells % n], dim=-1)
        unit = (corner + torch.rand(len(cells), 3, device=cells.device)) / n
        positions = torch.lerp(self.box[0], self.box[1], unit)
        sigma = _in_chunks(density, positions, None) if not self.moving else _over_time(density, positions)
        before = self.density_grid.index_select(0, cells)
        before *= WARM_UP_DECAY if warming_up else MOVING_DECAY if self.moving else DECAY
        seen = torch.isfinite(before)
        self.density_grid.index_copy_(0, cells, torch.where(seen, torch.maximum(before, sigma), sigma))
        refresh_occupancy(self.density_grid, self.occupied, 1.0, self.step_size, self.alpha_threshold)
        if self.any_carved:
            self.occupied.logical_and_(~self.carved)
        self.forget()

    def _shuffled(self, turn: int) -> Tensor:
        """The cells of one of the first updates: four passes over the grid by step WARM_UP_STEPS.

        Of cells already found empty, which stay so unless the field changes its mind, one in eight is looked at.
        """
        num_cells = self.resolution**3
        share = math.ceil(4 * num_cells * 8 / WARM_UP_STEPS)
        places = torch.arange(turn * share, (turn + 1) * share, device=self.occupied.device)
        cells = places * SHUFFLE_STRIDE % num_cells
        looked_at = self.occupied.index_select(0, cells) | (torch.rand(share, device=cells.device) < 1 / 8)
        return cells[looked_at & ~self.carved.index_select(0, cells)]

    def _drawn(self) -> Tensor:
        """A third anywhere, a third among occupied cells, a third beside those.

        Cells beside are those that matter reaches into a little, and that one look may take for empty: of a thin shell
        the error is 30 times less with them than without (`ns-bench quadrature`). A cell drawn twice is evaluated
        twice, harmlessly.
        """
        num_cells = self.resolution**3
        third = max(num_cells // 64, 1)
        device = self.occupied.device
        occupied = self.occupied.nonzero().squeeze(-1)
        anywhere = torch.randint(num_cells, (third,), device=device)
        anywhere = anywhere[~self.carved[anywhere]]
        if len(occupied) == 0:
            return anywhere
        known, within = (occupied[torch.randint(len(occupied), (third,), device=device)] for _ in range(2))
        beside = self._beside(within)
        return torch.cat([anywhere, known, beside[~self.carved[beside]]])

    def _beside(self, cells: Tensor) -> Tensor:
        """A random neighbour of each cell: where matter may reach, or, where something moves, may have come to."""
        n = self.resolution
        corner = torch.stack([cells // n**2, cells // n % n, cells % n], dim=-1)
        corner = (corner + torch.randint(-1, 2, corner.shape, device=cells.device)).clamp(0, n - 1)
        return (corner[:, 0] * n + corner[:, 1]) * n + corner[:, 2]


def _attached(samples: Samples, surface: HasAlpha | None, stopping: Tensor, features: Tensor) -> Samples:
    """Return samples with their density, or with the opacity of a surface's intervals, and features."""
    return samples.evaluated(stopping, features) if surface is None else samples.with_alpha(stopping, features)


def _over_time(density: DensityFunction, positions: Tensor) -> Tensor:
    """The largest density (N,) at a few random times, one in each equal part: something may pass a cell quickly."""
    found = []
    for part in range(TIMES_PER_VISIT):
        times = (part + torch.rand(len(positions), device=positions.device)) / TIMES_PER_VISIT
        found.append(_in_chunks(density, positions, times))
    return torch.stack(found).amax(0)


def _in_chunks(density: DensityFunction, positions: Tensor, times: Tensor | None) -> Tensor:
    """Density (N,) at positions (N, 3), a chunk at a time: fresh memory of many megabytes costs more than the work."""
    parts = positions.split(CHUNK)
    when = [None] * len(parts) if times is None else times.split(CHUNK)
    return torch.cat([density(Points(part, t))[0] for part, t in zip(parts, when, strict=True)])

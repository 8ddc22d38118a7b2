"""Sampling with an occupancy grid, which skips empty space, in waves, which skip hidden space.

The grid is that of Instant-NGP (Mueller et al. 2022, appendix E.2): it holds a decaying maximum of the density in each
cell, and a cell is skipped while a step through it is nearly transparent. A scene without bounds has several nested
boxes, each twice as large as the one before, through which steps grow with distance; all that is behind the largest is
one last sample, as long as it takes to be opaque. The grid of a moving scene in one box may have slices of time, so
that a ray skips what is empty at its own time.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from nerfloom.base import device as devices
from nerfloom.base.errors import ConfigError, shown
from nerfloom.base.step_kind import StepKind
from nerfloom.fields.base import DensityFunction, Field, HasAlpha, HasGridDensity
from nerfloom.geometry.bounds import nested_boxes
from nerfloom.geometry.points import interval_points
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.argument_checks import is_followed
from nerfloom.kernels.compositing.alpha import alpha_depth
from nerfloom.kernels.march.fixed_slots import most_steps
from nerfloom.kernels.march.occupancy import own_cells
from nerfloom.kernels.march.waves import RUN, March, Occupancy, Wave, march, refresh_occupancy
from nerfloom.kernels.result_cache import Waves
from nerfloom.kernels.rows import gather_rows
from nerfloom.kernels.traced.trace import trace
from nerfloom.samplers.base import Sampler
from nerfloom.samplers.cells import beside, densities_over_time, places
from nerfloom.samplers.fixed import Steps, attached, sample_into_slots
from nerfloom.samplers.sample_capacity import Room

MAX_CELLS = 512
"""Maximum number of cells along an axis; the state of 512^3 cells takes 0.8 GB."""
MAX_LEVELS = 16
"""Maximum number of nested boxes."""
FARTHEST = 1e10
"""Far end of the last sample of an endless ray, scene units."""
WARM_UP_STEPS = 256
"""Number of training steps in which the cells are updated in the order of a fixed shuffle."""
WARM_UP_DECAY, DECAY = 0.7, 0.8
"""Factors of a cell's density at each update, during warm-up and afterwards."""
TIMES_PER_VISIT, CELLS_A_TIME, MOVING_DECAY = 4, 6, 0.95
"""Times at which a cell of a moving scene is evaluated at each update: with slices of time, one for as many cells as
matter may cross in a slice, up to this number. Factor of a density that is not kept in slices, for it may be rare."""
SHARE, SHARE_OF_SLICES = 64, 512
"""Numbers of cells for each one that is drawn from all cells at an update after warm-up, without and with slices of
time. With them there are more cells, of which fewer are occupied."""
PASSES, PASSES_OF_SLICES = 4, 1
"""Passes over all cells during warm-up, without and with slices of time."""
COARSE_STEPS = (WARM_UP_STEPS // 4, 4.0), (WARM_UP_STEPS, 2.0)
"""Training steps until which the march through nested boxes takes longer steps, and how much longer these are. While
nothing is known to be empty, few rays would take all samples."""
SHUFFLE_STRIDE = 2654435761
"""A prime number, whose multiples modulo the number of cells visit every cell once per pass, in scattered order."""


class OccupancySampler(Sampler):
    """Samples at steps through the occupied cells of a box, or of nested boxes.

    Args:
        box: (2, 3) corners of the box, the smallest if there are several, scene units.
        resolution: cells along each axis of a box.
        num_steps: steps along the diagonal of the box.
        early_stop: transmittance below which the rest of a ray is dropped: the maximum error of a colour channel. 0
            drops nothing.
        train_early_stop: the same threshold during training, where less exact colours are sufficient; `early_stop` if
            None.
        alpha_threshold: a cell is occupied if the opacity of one step through it is at least this, or at least the mean
            over its box, or over the smallest one, if both are less.
        cone: growth of the step per unit of distance, beyond the distance where it exceeds the even step; 0 for even
            steps throughout.
        moving: whether the scene changes with time; a cell is then occupied if it is at any time of its slice.
        levels: number of nested boxes, each of twice the size and with as many cells.
        endless: whether rays have a last sample for all that is behind the largest box, which any density makes opaque:
            for images without an alpha channel.
        slices: number T of equal parts of the time from 0 to 1, each of which has cells of its own.
        eval_step_scale: length of a step outside of training, in those of training.

    Raises:
        ConfigError: if the number of cells, boxes, slices or steps is out of range.
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
        levels: int = 1,
        endless: bool = False,
        slices: int = 1,
        eval_step_scale: float = 1.0,
    ) -> None:
        super().__init__()
        if not 1 <= resolution <= MAX_CELLS or not num_steps >= 1:
            raise ConfigError(
                f"an occupancy grid has 1 to {MAX_CELLS} cells along an axis and 1 step or more, "
                f"not {shown(resolution)} and {shown(num_steps)}"
            )
        if not 1 <= levels <= MAX_LEVELS or (levels > 1 and resolution % 4):
            raise ConfigError(
                f"1 to {MAX_LEVELS} boxes are nested, with a multiple of 4 cells along an axis, "
                f"not {shown(levels)} with {resolution}"
            )
        if slices != 1 and not (1 < slices * resolution**3 <= MAX_CELLS**3 and slices > 0 and moving and levels == 1):
            raise ConfigError(
                f"{shown(slices)} slices of time: there is 1, or more in one box of a scene that moves, with at most "
                f"{MAX_CELLS}^3 cells in all"
            )
        self.resolution, self.levels, self.endless, self.slices = resolution, levels, endless, slices
        self.step_size, self.num_steps = (box[1] - box[0]).norm().item() / num_steps, num_steps
        self.room = Room(math.ceil(most_steps(num_steps) / RUN), most_steps(num_steps))
        self.always_fixed = False
        """Whether training steps have a fixed number of samples on the CPU too, for tests and counts."""
        self.early_stop = early_stop
        self.train_early_stop = early_stop if train_early_stop is None else train_early_stop
        self.alpha_threshold = alpha_threshold
        self.cone = cone
        self.moving = moving
        self._stride, self._eval_stride = 1.0, eval_step_scale
        self._times_per_visit = max(TIMES_PER_VISIT // slices, 1)
        self.register_buffer("box", box.clone())
        self.register_buffer("occupied", own_cells(levels, resolution).repeat(slices).to(box.device))
        self.register_buffer("carved", ~self.occupied)
        self.register_buffer("density_grid", torch.where(self.occupied, torch.inf, 0.0))
        self._packed: Occupancy | None = None
        self._kept: tuple[int, Tensor | None] | None = None
        self.register_load_state_dict_post_hook(lambda module, _: module.forget_all())

    @property
    def occupied_share(self) -> float:
        """Fraction of the cells that are occupied, of those that are not in a smaller box."""
        return int(self.occupied.sum()) / (self.slices * int(own_cells(self.levels, self.resolution).sum()))

    @property
    def occupancy(self) -> Occupancy:
        """The grid in the form that `march` needs."""
        if self._packed is None or self._packed.occupied is not self.occupied:
            self._packed = Occupancy(self.occupied, self.box, self.resolution, self.levels, self.slices)
        return self._packed

    def kept(self) -> tuple[int, Tensor | None]:
        """Return the number K of the cells that are not carved, and their indices (K,) int32; None if these are all."""
        known = self._kept
        if known is None or (known[1] is not None and known[1].device != self.carved.device):
            found = (~self.carved).nonzero().squeeze(-1).int()
            known = self._kept = len(found), found if len(found) < len(self.carved) else None
        return known

    def occupied_when(self, time: float | None = None) -> Tensor:
        """Return the cells (L n^3,) that are occupied in the slice of `time`, or at any time if it is None."""
        of_slices = self.occupied.view(self.slices, -1)
        if time is None:
            return of_slices.any(0)
        return of_slices[min(max(int(time * self.slices), 0), self.slices - 1)]

    def forget_all(self) -> None:
        """Discard also which cells are not carved; to be called after `carved` has changed."""
        self._kept = None
        self.forget()

    def forget(self) -> None:
        """Discard `occupancy`, which is computed again on demand; to be called after `occupied` has changed."""
        if self._packed is not None and self._has_fixed_sizes:
            self._packed.refresh()
        else:
            self._packed = None

    @property
    def _has_fixed_sizes(self) -> bool:
        """Whether training steps take a fixed number of samples, for which Python need not wait for the device."""
        ahead = self.always_fixed or devices.runs_ahead(self.occupied.device)
        return ahead and self.levels == 1 and not self.cone and not self.endless

    # -- sampling ---------------------------------------------------------------------------------------------

    def sample(self, rays: Rays, field: Field, jitter: bool, early_stop: float | None = None) -> Samples:
        """Return samples in occupied cells, up to the early stop, with densities and features attached.

        A ray whose light reaches past the largest box of an endless grid has one sample more.

        The samples that are dropped could have changed a colour channel by at most the threshold of the early stop.

        Args:
            rays: R rays; they must not require a gradient.
            field: the field, which is evaluated at the samples.
            jitter: True to start each ray at a random fraction of a step, False to start at 0.
            early_stop: transmittance below which the rest of a ray is dropped; if None, the sampler's own:
                `train_early_stop` in training mode, and else `early_stop`.

        Raises:
            ValueError: if the rays require a gradient, which marched samples do not have.
        """
        own = self.train_early_stop if self.training else self.early_stop
        stop = own if early_stop is None else early_stop
        surface = field if isinstance(field, HasAlpha) else None

        def evaluate(wave: Wave) -> tuple[Tensor, Tensor]:
            points = interval_points(rays, wave.owners, wave, wave.positions, field.footprint)
            if surface is None:
                return field.density(points)
            return surface.alpha(points, rays.directions.index_select(0, wave.owners), wave.t_ends - wave.t_starts)

        if self.is_fixed(rays):
            steps = Steps(self.occupancy, self.step_size, self.num_steps, self._shift(rays, jitter))
            return sample_into_slots(rays, steps, self.room, evaluate, surface, stop, self.samples_per_step)
        marched = self.begin(rays, jitter, stop)
        if isinstance(field, HasGridDensity) and not self.endless:
            known = field.grid_density()
            if known is not None:
                found = trace(marched, known)
                intervals = found.t_starts, found.t_ends, found.offsets
                samples = Samples(*intervals, owners=found.owners, longest=found.longest, early_stop=stop)
                return samples.evaluated(found.sigma, found.features)

        evaluated = Waves()
        while (wave := marched.wave(marched.next_limit)) is not None:
            stopping = evaluated.evaluate(len(wave.owners), partial(evaluate, wave))[0]
            if surface is not None:  # the march needs the density with the same opacity in each interval
                stopping = alpha_depth(stopping.detach()) / (wave.t_ends - wave.t_starts)
            marched.advance(stopping)
        rest = marched.rest(self.occupancy.outer) if self.endless else None
        if rest is not None:
            evaluated.evaluate(len(rest.owners), partial(evaluate, rest))
        order, offsets = marched.finish()
        if not (waves := marched.waves):  # no occupied cell on any ray: empty tensors with the field's shapes and types
            empty = rays.nears[:0]
            samples = Samples(empty, empty, offsets, owners=order, early_stop=stop)
            return attached(samples, surface, *evaluate(Wave(empty, empty, order, rays.origins[:0])))
        columns = [[w.t_starts for w in waves], [w.t_ends for w in waves], [w.owners for w in waves]]
        starts, ends, owners = gather_rows(columns, order)

        def chosen() -> tuple[Tensor, Tensor]:
            (positions,) = gather_rows([[w.positions for w in waves]], order)
            return evaluate(Wave(starts, ends, owners, positions))

        samples = Samples(starts, ends, offsets, owners=owners, longest=marched.longest, early_stop=stop)
        if rest is not None:
            samples = _opened(samples, rest.owners)
        return attached(samples, surface, *evaluated.choose(order, chosen))

    def is_fixed(self, rays: Rays) -> bool:
        """Return whether `sample` returns a number of samples of `rays` that does not depend on what is on them."""
        return self.training and len(rays) > 0 and self._has_fixed_sizes

    def step_kind(self, step: int) -> StepKind:
        return StepKind(self.room.per_ray) if self._has_fixed_sizes else super().step_kind(step)

    def read_counts(self) -> None:
        self.room.read()

    def begin(self, rays: Rays, jitter: bool, early_stop: float) -> March:
        """Return a march before its first wave.

        Args:
            rays: R rays; they must not require a gradient.
            jitter: True to start each ray at a random fraction of a step, False to start at 0.
            early_stop: transmittance below which the rest of a ray is dropped.

        Raises:
            ValueError: if the rays require a gradient, which marched samples do not have.
        """
        stride, shift = self._stride if self.training else self._eval_stride, self._shift(rays, jitter)
        return march(rays, self.occupancy, stride * self.step_size, stride * self.cone, shift, early_stop)

    def _shift(self, rays: Rays, jitter: bool) -> Tensor | None:
        if is_followed(rays.origins, rays.directions):
            raise ValueError("marched samples carry no gradient to rays: detach these, or take a ProposalSampler")
        return torch.rand(len(rays), device=rays.origins.device) if jitter else None

    # -- updating the grid ------------------------------------------------------------------------------------

    def carve(self, hull: Tensor) -> None:
        """Mark cells as empty, permanently.

        Args:
            hull: (L n^3,) or (T n^3,) bool (`nerfloom.scene.silhouettes`), False for these cells; or, with slices of
                time, (n^3,) for all of them.
        """
        own = own_cells(self.levels, self.resolution).to(hull.device)
        self.carved.view(self.slices, -1).copy_(~(hull.view(-1, len(own)) & own))
        self.density_grid.masked_fill_(self.carved, 0)
        self.occupied.masked_fill_(self.carved, False)
        self.forget_all()

    def expect_motion(self, distance: float) -> None:
        """Evaluate a cell at more times in each update if matter crosses many cells meanwhile.

        Args:
            distance: distance that matter may move in one slice of time, scene units.
        """
        cells = distance * self.resolution / float((self.box[1] - self.box[0]).max())
        wanted = min(math.ceil(cells / CELLS_A_TIME), TIMES_PER_VISIT)
        self._times_per_visit = max(self._times_per_visit, wanted)

    @torch.no_grad()
    def update(self, step: int, density: DensityFunction) -> None:
        """Evaluate the density in some cells and update `occupied`, every 8 steps during warm-up and every 16 later.

        During warm-up the cells are taken in the order of a fixed shuffle, so that all are evaluated soon; those of
        nested boxes are all occupied until then. Afterwards one part is drawn from all cells that are not carved, so
        that an empty cell can become occupied again, one part from the occupied cells, and one part from the neighbours
        of occupied cells.

        Args:
            step: number of training steps done.
            density: density of the field.
        """
        warming_up = step < WARM_UP_STEPS
        if self.levels > 1:
            self._stride = next((longer for until, longer in COARSE_STEPS if step < until), 1.0)
        if step == 0:
            self.kept()  # for which a device is waited for, before the first step
        if step == 0 or step % (8 if warming_up else 16):
            return
        cells = self._shuffled(step // 8 - 1) if warming_up else self._drawn()
        place = places(cells, self.resolution)
        unit = (place[:, 1:] + torch.rand(len(cells), 3, device=cells.device)) / self.resolution
        low, high = self.box if self.levels == 1 else nested_boxes(self.box, self.levels)[place[:, 0]].unbind(1)
        positions = torch.lerp(low, high, unit)
        looks, starts = self._times_per_visit if self.moving else 0, place[:, 0] * (self.levels == 1) / self.slices
        sigma = densities_over_time(density, positions, starts, 1 / self.slices, looks)
        before = self.density_grid.index_select(0, cells)
        before *= WARM_UP_DECAY if warming_up else MOVING_DECAY if self.moving and self.slices == 1 else DECAY
        evaluated = torch.isfinite(before)
        self.density_grid.index_copy_(0, cells, torch.where(evaluated, torch.maximum(before, sigma), sigma))
        if self.levels > 1 and step < WARM_UP_STEPS // 4:
            return  # cells that are not known yet would raise the mean, and empty all that are
        densities, occupied = self.density_grid.view(self.levels, -1), self.occupied.view(self.levels, -1)
        middle = 0.0  # mean opacity in the smallest of several boxes
        for number, step_size in enumerate(self._step_sizes()):
            refresh_occupancy(densities[number], occupied[number], 1.0, step_size, self.alpha_threshold, middle)
            if number == 0 and self.levels > 1:
                middle = float(-torch.expm1(-densities[0] * step_size).nanmean().nan_to_num())
        self.occupied.logical_and_(~self.carved)
        self.forget()

    def _step_sizes(self) -> list[float]:
        """Return the length of a step in each box: near the faces, of a ray from the middle, if steps grow."""
        if self.levels == 1:
            return [self.step_size]
        half = float((self.box[1] - self.box[0]).min()) / 2
        return [max(self.step_size, self.cone * half * 2**level) for level in range(self.levels)]

    def _shuffled(self, turn: int) -> Tensor:
        """Return the cells of update number `turn` during warm-up, which makes four passes over the grid.

        Only one in eight of the empty cells is returned, because few of them become occupied again.
        """
        num_kept, kept = self.kept()
        count = math.ceil((PASSES if self.slices == 1 else PASSES_OF_SLICES) * num_kept * 8 / WARM_UP_STEPS)
        ranks = torch.arange(turn * count, (turn + 1) * count, device=self.occupied.device)
        cells = ranks * SHUFFLE_STRIDE % max(num_kept, 1)
        cells = cells if kept is None else kept.index_select(0, cells).long()
        return cells[self.occupied.index_select(0, cells) | (torch.rand(count, device=cells.device) < 1 / 8)]

    def _drawn(self) -> Tensor:
        """Return random cells of all that are not carved, of the occupied ones, and of their neighbours.

        Matter that reaches only a little into a neighbour may be missed by one evaluation: for a thin shell the error
        is 30 times smaller with the neighbours than without (benchmarks/quadrature.py). A cell that is drawn twice is
        evaluated twice, which does no harm.
        """
        device, share = self.occupied.device, SHARE if self.slices == 1 else SHARE_OF_SLICES
        num_kept, kept = self.kept()
        third = max(len(self.occupied) // share, 1)
        anywhere = torch.randint(max(num_kept, 1), (math.ceil(num_kept / share),), device=device)
        anywhere = anywhere if kept is None else kept[anywhere].long()
        if kept is None or 2 * num_kept > len(self.occupied):
            occupied = self.occupied.nonzero().squeeze(-1)
        else:
            occupied = kept[self.occupied.index_select(0, kept)].long()
        if len(occupied) == 0:
            return anywhere
        drawn, centers = (occupied[torch.randint(len(occupied), (third,), device=device)] for _ in range(2))
        neighbours = beside(centers, self.resolution, self.levels * self.slices, self.slices > 1)
        return torch.cat([anywhere, drawn, neighbours[~self.carved[neighbours]]])


def _opened(samples: Samples, rays: Tensor) -> Samples:
    """Return samples that are evaluated where they were, the last one of each of `rays` (K,) ending at `FARTHEST`."""
    ends = samples.t_ends.clone()
    ends[samples.offsets[rays + 1] - 1] = FARTHEST
    return replace(samples, t_ends=ends, points=samples.t)

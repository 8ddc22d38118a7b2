"""Sampling with an occupancy grid, which skips empty space, in waves, which skip hidden space.

The grid follows Instant-NGP (Mueller et al. 2022, appendix E.2). It holds a decaying maximum of the density in each
cell; a cell is skipped while a step through it is nearly transparent. An unbounded scene has several nested boxes, each
twice as large as the one before, and steps grow with distance. One last sample, long enough to be opaque, covers all
space behind the largest box. The grid of a moving scene in one box may have slices of time, so that a ray skips cells
that are empty at its own time.
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
from nerfloom.kernels.march.occupancy import Occupancy, own_cells, refresh_occupancy
from nerfloom.kernels.march.waves import RUN, March, Wave, march
from nerfloom.kernels.result_cache import Waves
from nerfloom.kernels.rows import gather_rows
from nerfloom.kernels.traced.trace import trace
from nerfloom.samplers.base import Sampler
from nerfloom.samplers.cells import beside, densities_over_time, places
from nerfloom.samplers.fixed import Steps, attached, sample_into_slots
from nerfloom.samplers.sample_capacity import SampleCapacity

MAX_CELLS = 512
"""Maximum number of cells along an axis; the state of 512^3 cells takes 0.8 GB."""
MAX_LEVELS = 16
"""Maximum number of nested boxes."""
ENDLESS_FAR = 1e10
"""Far end of the last sample of an endless ray, scene units."""
WARM_UP_STEPS = 256
"""Number of first training steps that update cells in a fixed shuffled order."""
WARM_UP_DECAY, DECAY = 0.7, 0.8
"""Factors of a cell's density at each update, during warm-up and afterwards."""
TIMES_PER_VISIT, CELLS_A_TIME, MOVING_DECAY = 4, 6, 0.95
"""Number of evaluations of a cell of a moving scene in each update. With time slices there is one for
every `CELLS_A_TIME` cells that matter may cross in a slice, up to this maximum. `MOVING_DECAY` replaces the decay
without slices, because an occupied time may be rare."""
CELLS_PER_DRAW, CELLS_PER_DRAW_OF_SLICES = 64, 512
"""One in this many of all cells is drawn in each update after warm-up, without and with time slices. With slices there
are more cells, and a smaller fraction is occupied."""
PASSES, PASSES_OF_SLICES = 4, 1
"""Number of passes over all cells during warm-up, without and with time slices."""
COARSE_STEPS = (WARM_UP_STEPS // 4, 4.0), (WARM_UP_STEPS, 2.0)
"""Pairs of a number of training steps, and the relative length of steps of the march through nested boxes until then.
Without known empty cells, few rays would use up all samples."""
SHUFFLE_STRIDE = 2654435761
"""A prime number. Its multiples modulo the number of cells visit every cell once per pass, in scattered order."""


class OccupancySampler(Sampler):
    """Samples at steps through the occupied cells of a box, or of nested boxes.

    Args:
        box: (2, 3) corners of the box, scene units; of the smallest box if there are several.
        resolution: cells along each axis of a box.
        num_steps: steps along the diagonal of the box.
        early_stop: transmittance below which the rest of a ray is dropped: the maximum error of a colour channel. 0
            disables the early stop.
        train_early_stop: the same threshold during training, where less exact colours suffice; `early_stop` if None.
        alpha_threshold: a cell is occupied if the opacity of one step through it reaches this threshold or, if that is
            less, the mean opacity over its box or over the smallest box, whichever is larger.
        cone: growth of the step per unit of distance, once this exceeds the even step; 0 for even steps throughout.
        moving: whether the scene changes with time; a cell then counts as occupied if it is so at any time of its
            slice.
        levels: number of nested boxes; each is twice as large as the one before, with the same number of cells.
        endless: whether rays have a last sample for all space behind the largest box; any density makes it opaque. For
            images without an alpha channel.
        slices: number T of equal parts of the time from 0 to 1, each with its own cells.
        eval_step_scale: length of a step outside of training, relative to a training step.

    Raises:
        ConfigError: if the number of cells, boxes, slices or steps is out of range.
    """

    carries_gradients = False
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
                f"an occupancy grid needs 1 to {MAX_CELLS} cells along an axis and at least 1 step, "
                f"not {shown(resolution)} and {shown(num_steps)}"
            )
        if not 1 <= levels <= MAX_LEVELS or (levels > 1 and resolution % 4):
            raise ConfigError(
                f"an occupancy grid has 1 to {MAX_LEVELS} nested boxes with a multiple of 4 cells along an axis, "
                f"not {shown(levels)} with {resolution}"
            )
        if slices != 1 and not (1 < slices * resolution**3 <= MAX_CELLS**3 and slices > 0 and moving and levels == 1):
            raise ConfigError(
                f"{shown(slices)} slices of time: several need one box of a moving scene, and at most "
                f"{MAX_CELLS}^3 cells in all"
            )
        self.resolution, self.levels, self.endless, self.slices = resolution, levels, endless, slices
        self.step_size, self.num_steps = (box[1] - box[0]).norm().item() / num_steps, num_steps
        self.capacity = SampleCapacity(math.ceil(most_steps(num_steps) / RUN), most_steps(num_steps))
        self.always_fixed = False
        """Whether training steps use a fixed number of samples on the CPU too, for tests and counts."""
        self.early_stop = early_stop
        self.train_early_stop = early_stop if train_early_stop is None else train_early_stop
        self.alpha_threshold = alpha_threshold
        self.cone = cone
        self.moving = moving
        self.stride, self._eval_stride = 1.0, eval_step_scale
        self._times_per_visit = max(TIMES_PER_VISIT // slices, 1)
        self.register_buffer("box", box.clone())
        self.register_buffer("occupied", own_cells(levels, resolution).repeat(slices).to(box.device))
        self.register_buffer("carved", ~self.occupied)
        self.register_buffer("density_grid", torch.where(self.occupied, torch.inf, 0.0))
        self._packed: Occupancy | None = None
        self._kept: tuple[int, Tensor | None] | None = None
        self.register_load_state_dict_post_hook(lambda module, _: module.forget_all())

    @property
    def occupancy(self) -> Occupancy:
        """The grid in the form for `march`."""
        if self._packed is None or self._packed.occupied is not self.occupied:
            self._packed = Occupancy(self.occupied, self.box, self.resolution, self.levels, self.slices)
        return self._packed

    def kept(self) -> tuple[int, Tensor | None]:
        """Return the number K of cells that are not carved, and their indices (K,) int32; None if no cell is carved."""
        known = self._kept
        if known is None or (known[1] is not None and known[1].device != self.carved.device):
            found = (~self.carved).nonzero().squeeze(-1).int()
            known = self._kept = len(found), found if len(found) < len(self.carved) else None
        return known

    def occupied_when(self, time: float | None = None) -> Tensor:
        """Return the cells (L n^3,) that are occupied in the time slice of `time`; at any time if it is None."""
        of_slices = self.occupied.view(self.slices, -1)
        if time is None:
            return of_slices.any(0)
        return of_slices[min(max(int(time * self.slices), 0), self.slices - 1)]

    def forget_all(self) -> None:
        """Discard the cached list of cells that are not carved; must be called after `carved` has changed."""
        self._kept = None
        self.forget()

    def forget(self) -> None:
        """Discard the cached `occupancy`; must be called after `occupied` has changed."""
        if self._packed is not None and self._has_fixed_sizes:
            self._packed.refresh()
        else:
            self._packed = None

    @property
    def _has_fixed_sizes(self) -> bool:
        """Whether training steps use a fixed number of samples, so that Python need not wait for the device."""
        ahead = self.always_fixed or devices.runs_ahead(self.occupied.device)
        return ahead and self.levels == 1 and not self.cone and not self.endless

    # -- sampling ---------------------------------------------------------------------------------------------

    def sample(self, rays: Rays, field: Field, jitter: bool, early_stop: float | None = None) -> Samples:
        """Return samples in occupied cells, up to the early stop, with densities and features attached.

        In an endless grid, a ray gets one more sample if its light reaches beyond the largest box. The dropped samples
        change a colour channel by at most the threshold of the early stop.

        Args:
            rays: R rays; they must not require a gradient.
            field: the field, which is evaluated at the samples.
            jitter: True to start each ray at a random fraction of a step, False to start at 0.
            early_stop: transmittance below which the rest of a ray is dropped. If None, `train_early_stop` in training
                mode, otherwise `early_stop`.

        Raises:
            ValueError: if the rays require a gradient, because marched samples have none.
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
            steps = Steps(self.occupancy, self.stride * self.step_size, self.num_steps, self._shift(rays, jitter))
            return sample_into_slots(rays, steps, self.capacity, evaluate, surface, stop, self.samples_per_step)
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
            if surface is not None:  # the march needs the density that gives the same opacity
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
        """Return whether the number of samples of `rays` is independent of the grid's contents."""
        return self.training and len(rays) > 0 and self._has_fixed_sizes

    def step_kind(self, step: int) -> StepKind:
        return StepKind(self.capacity.per_ray) if self._has_fixed_sizes else super().step_kind(step)

    def read_counts(self) -> None:
        self.capacity.read()

    def begin(self, rays: Rays, jitter: bool, early_stop: float) -> March:
        """Return a march positioned before its first wave.

        Args:
            rays: R rays; they must not require a gradient.
            jitter: True to start each ray at a random fraction of a step, False to start at 0.
            early_stop: transmittance below which the rest of a ray is dropped.

        Raises:
            ValueError: if the rays require a gradient, because marched samples have none.
        """
        stride, shift = self.stride if self.training else self._eval_stride, self._shift(rays, jitter)
        return march(rays, self.occupancy, stride * self.step_size, stride * self.cone, shift, early_stop)

    def _shift(self, rays: Rays, jitter: bool) -> Tensor | None:
        if is_followed(rays.origins, rays.directions):
            raise ValueError("marched samples carry no gradient to rays: detach the rays or use a ProposalSampler")
        return torch.rand(len(rays), device=rays.origins.device) if jitter else None

    # -- updating the grid ------------------------------------------------------------------------------------

    def carve(self, hull: Tensor) -> None:
        """Mark cells as empty, permanently.

        Args:
            hull: (L n^3,) or (T n^3,) bool (`nerfloom.scene.silhouettes`), False for these cells. With time slices also
                (n^3,), for all slices.
        """
        own = own_cells(self.levels, self.resolution).to(hull.device)
        self.carved.view(self.slices, -1).copy_(~(hull.view(-1, len(own)) & own))
        self.density_grid.masked_fill_(self.carved, 0)
        self.occupied.masked_fill_(self.carved, False)
        self.forget_all()

    def expect_motion(self, distance: float) -> None:
        """Evaluate each cell at more times per update if matter crosses many cells within a slice.

        Args:
            distance: maximum distance that matter moves in one slice of time, scene units.
        """
        cells = distance * self.resolution / float((self.box[1] - self.box[0]).max())
        wanted = min(math.ceil(cells / CELLS_A_TIME), TIMES_PER_VISIT)
        self._times_per_visit = max(self._times_per_visit, wanted)

    @torch.no_grad()
    def update(self, step: int, density: DensityFunction) -> None:
        """Evaluate the density in some cells and update `occupied`, every 8 steps during warm-up and every 16 later.

        During warm-up the cells are visited in a fixed shuffled order, so that all are evaluated soon; until then,
        cells of nested boxes count as occupied. Afterwards, one part is drawn from all cells that are not carved, so
        that an empty cell can become occupied again. Further parts are drawn from the occupied cells and from their
        neighbours.
        """
        warming_up = step < WARM_UP_STEPS
        if self.levels > 1:
            self.stride = next((longer for until, longer in COARSE_STEPS if step < until), 1.0)
        if step == 0:
            self.kept()  # waits for the device once, before the first step
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
            return  # unknown cells would raise the mean, which would empty all known ones
        densities, occupied = self.density_grid.view(self.levels, -1), self.occupied.view(self.levels, -1)
        middle = 0.0  # mean opacity in the smallest of several boxes
        for number, step_size in enumerate(self._step_sizes()):
            refresh_occupancy(densities[number], occupied[number], 1.0, step_size, self.alpha_threshold, middle)
            if number == 0 and self.levels > 1:
                middle = float(-torch.expm1(-densities[0] * step_size).nanmean().nan_to_num())
        self.occupied.logical_and_(~self.carved)
        self.forget()

    def _step_sizes(self) -> list[float]:
        """Return the step length in each box; with growing steps, that near its faces for a ray from the middle."""
        if self.levels == 1:
            return [self.step_size]
        half = float((self.box[1] - self.box[0]).min()) / 2
        return [max(self.step_size, self.cone * half * 2**level) for level in range(self.levels)]

    def _shuffled(self, turn: int) -> Tensor:
        """Return the cells of update number `turn` during warm-up, which makes four passes over the grid.

        Only one in eight of the empty cells is returned, because few become occupied again.
        """
        num_kept, kept = self.kept()
        count = math.ceil((PASSES if self.slices == 1 else PASSES_OF_SLICES) * num_kept * 8 / WARM_UP_STEPS)
        ranks = torch.arange(turn * count, (turn + 1) * count, device=self.occupied.device)
        cells = ranks * SHUFFLE_STRIDE % max(num_kept, 1)
        cells = cells if kept is None else kept.index_select(0, cells).long()
        return cells[self.occupied.index_select(0, cells) | (torch.rand(count, device=cells.device) < 1 / 8)]

    def _drawn(self) -> Tensor:
        """Return random cells: of all that are not carved, of the occupied cells, and of their neighbours.

        Matter that reaches only a little into a neighbour may be missed by one evaluation: for a thin shell the error
        is 30 times smaller with the neighbours than without (benchmarks/quadrature.py). A cell that is drawn twice is
        evaluated twice, which does no harm.
        """
        device, share = self.occupied.device, CELLS_PER_DRAW if self.slices == 1 else CELLS_PER_DRAW_OF_SLICES
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
    """Return samples with unchanged positions; the last sample of each of `rays` (K,) ends at `ENDLESS_FAR`."""
    ends = samples.t_ends.clone()
    ends[samples.offsets[rays + 1] - 1] = ENDLESS_FAR
    return replace(samples, t_ends=ends, points=samples.t)

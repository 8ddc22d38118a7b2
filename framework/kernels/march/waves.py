"""Marching of rays through an occupancy grid, in waves.

The candidates of a ray are the steps first + k * step, which grow with distance beyond step / cone (Instant-NGP,
Mueller et al. 2022, appendix E.1). Candidates with their middle in an occupied cell are samples. A wave consists of the
next few samples of every active ray. When their density is known, `advance` ends rays with low transmittance. So hidden
samples are not evaluated, and no sample is evaluated twice. Finally, `rest` adds a sample for all space behind the
grid. On devices other than the CPU a wave costs more than unnecessary samples: the form in PyTorch takes all samples in
one wave if they are few.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from nerfloom.geometry.bounds import intersect_box
from nerfloom.geometry.rays import Rays
from nerfloom.kernels import native
from nerfloom.kernels.compositing.density import bounded_sum, optical_depth
from nerfloom.kernels.dispatch import CPP, TRITON, Operation
from nerfloom.kernels.march.occupancy import Occupancy
from nerfloom.kernels.march.ray_order import sort_by_ray
from nerfloom.kernels.triton_backend import later

RUN = 8
"""Number of steps that the reference tests together."""
WAVES = (8, 8, 16, 32, 64, 128)
"""Samples per ray in each wave of a compiled march; the last size repeats."""
CAPACITY = 2**18
"""Maximum number of samples for the reference to take all candidates in one wave, because another wave would wait for a
GPU. With more samples, it is the approximate number per wave."""


@dataclass(frozen=True)
class Wave:
    """N samples evaluated together."""

    t_starts: Tensor
    """(N,) distance at the start of each interval."""
    t_ends: Tensor
    """(N,) distance at the end of each interval."""
    owners: Tensor
    """(N,) int64 index of the ray of each sample."""
    positions: Tensor
    """(N, 3) middle of each interval, scene coordinates."""

    @property
    def t(self) -> Tensor:
        """(N,) distance at the middle of each interval."""
        return (self.t_starts + self.t_ends) / 2


class March(ABC):
    """The state of a march: call `wave` and `advance` in turn until `wave` returns None, then `finish`.

    Args:
        rays: R rays.
        early_stop: transmittance below which a ray ends; 0 for never.
    """

    def __init__(self, rays: Rays, early_stop: float) -> None:
        self.rays = rays
        self.budget = -math.log(early_stop) if early_stop > 0 else math.inf
        self.waves: list[Wave] = []
        self.reached: list[Tensor] = []
        """(N,) uint8 for each wave: 1 for samples with a transmittance in front of them of at least `early_stop`."""
        self.longest: int | None = None
        """Upper bound of the number of samples on a ray; None if computing it would take a pass over them."""
        self.spent: Tensor
        """(R,) optical depth of the samples so far."""
        self.rested = False
        """Whether `rest` has added samples."""

    @property
    def next_limit(self) -> int:
        """Maximum number of samples per ray in the next wave."""
        return WAVES[min(len(self.waves), len(WAVES) - 1)]

    @abstractmethod
    def wave(self, limit: int) -> Wave | None:
        """Return up to `limit` samples on each active ray; None if all rays have ended."""

    @abstractmethod
    def advance(self, sigma: Tensor) -> None:
        """End rays with low transmittance or outside the box, from the densities `sigma` (N,) of the wave."""

    @torch.no_grad()
    def rest(self, box: Tensor) -> Wave | None:
        """Return a last sample, for all space behind `box` (2, 3), on each ray with light left; None if there are none.

        The sample starts where the ray leaves the box, or where the ray starts if it misses the box. It ends at the
        ray's far end, or at three times its start if that is farther. Call it when `wave` has returned None.
        """
        owners = (~(self.spent >= self.budget)).nonzero().squeeze(-1)
        if len(owners) == 0:
            return None
        rays = self.rays[owners]
        leave = intersect_box(rays.origins, rays.directions, box)[1]
        starts = torch.minimum(torch.maximum(leave, rays.nears), rays.fars)
        far = torch.where(rays.fars.isfinite(), rays.fars, starts)
        ends = torch.maximum(far, 3 * starts)
        wave = Wave(starts, ends, owners, self.rays.points(owners, (starts + ends) / 2))
        self.waves.append(wave)
        self.reached.append(torch.ones_like(owners, dtype=torch.uint8))
        self.rested, self.longest = True, None if self.longest is None else self.longest + 1
        return wave

    def finish(self) -> tuple[Tensor, Tensor]:
        """Return the order (M,) that sorts the reached samples of all waves by ray, and the rays' offsets (R + 1,)."""
        if not self.waves:
            counts = self.rays.nears.new_zeros(len(self.rays) + 1, dtype=torch.int64)
            return counts[:0], counts
        owners = torch.cat([wave.owners for wave in self.waves])
        return sort_by_ray(owners, torch.cat(self.reached), len(self.rays))


class CompiledMarch(March):
    """The compiled march, for float32 on the CPU.

    `rays`, `occupancy`, `step`, `cone`, `shift` and `early_stop` are as in `march`.
    """

    def __init__(
        self, rays: Rays, occupancy: Occupancy, step: float, cone: float, shift: Tensor | None, early_stop: float
    ) -> None:
        super().__init__(rays, early_stop)
        count = len(rays)
        self.step, self.cone, self.resolution, self.levels = step, cone, occupancy.resolution, occupancy.levels
        self.bits, self.blocks = occupancy.packed
        self.slices = occupancy.slices_of(rays.times)
        self.origins, self.directions = rays.origins.contiguous(), rays.directions.contiguous()
        self.enter, self.leave, self.first = (torch.empty(count) for _ in range(3))
        self.box, outer = occupancy.box.contiguous(), occupancy.outer.contiguous()
        alive = torch.empty(count, dtype=torch.int64)
        nears, fars = rays.nears.contiguous(), rays.fars.contiguous()
        shift = None if shift is None else shift.contiguous()
        hits = _begin(
            native.pointer(self.origins, "ray origins", (count, 3)),
            native.pointer(self.directions, "ray directions", (count, 3)),
            native.pointer(nears, "nears", (count,)), native.pointer(fars, "fars", (count,)),
            None if shift is None else native.pointer(shift, "the shift", (count,)), count,
            native.pointer(outer, "the box", (2, 3)), step, self.enter.data_ptr(), self.leave.data_ptr(),
            self.first.data_ptr(), alive.data_ptr(), native.threads(),
        )  # fmt: skip
        self.alive = alive[:hits]
        self.next = torch.zeros(count, dtype=torch.int32)
        self.spent = torch.zeros(count)

    def wave(self, limit: int) -> Wave | None:
        living, capacity = len(self.alive), len(self.alive) * limit
        if living == 0:
            return None
        self.counts, self.limit = torch.empty(living, dtype=torch.int32), limit
        starts, ends, positions = torch.empty(capacity), torch.empty(capacity), torch.empty(capacity, 3)
        owners = torch.empty(capacity, dtype=torch.int64)
        count = _wave(
            self.origins.data_ptr(), self.directions.data_ptr(), self.enter.data_ptr(), self.leave.data_ptr(),
            self.first.data_ptr(), None if self.slices is None else self.slices.data_ptr(), self.next.data_ptr(),
            self.alive.data_ptr(), living, limit, self.box.data_ptr(), self.step, self.cone, self.bits.data_ptr(),
            self.blocks.data_ptr(), self.resolution, self.levels, self.counts.data_ptr(), starts.data_ptr(),
            ends.data_ptr(), owners.data_ptr(), positions.data_ptr(), native.threads(),
        )  # fmt: skip
        wave = Wave(starts[:count], ends[:count], owners[:count], positions[:count])
        self.waves.append(wave)
        return wave

    def advance(self, sigma: Tensor) -> None:
        wave, living = self.waves[-1], len(self.alive)
        sigma = sigma.detach().float().contiguous()
        going_on, reached = torch.empty_like(self.alive), torch.empty(len(sigma), dtype=torch.uint8)
        left = _advance(
            self.alive.data_ptr(), living, self.counts.data_ptr(), self.limit,
            native.pointer(sigma, "density", tuple(wave.t_starts.shape)), wave.t_starts.data_ptr(),
            wave.t_ends.data_ptr(), self.budget, self.spent.data_ptr(), reached.data_ptr(), going_on.data_ptr(),
        )  # fmt: skip
        self.alive = going_on[:left]
        self.reached.append(reached)


def _chosen(mask: Tensor, owners: Tensor, num_rays: int) -> tuple[Tensor, Tensor, int]:
    """Return indices (M,) of samples, offsets (R + 1,) of their rays, and the maximum number on a ray.

    It waits for the device once, for both numbers, as often as `nonzero` does.

    Args:
        mask: (N,) bool, the samples.
        owners: (N,) int64 ray of each sample, in ascending order.
        num_rays: number R of rays.
    """
    counts = owners.new_zeros(num_rays).index_add_(0, owners, mask.long())
    total, longest = torch.stack([counts.sum(), counts.amax()]).tolist() if num_rays else (0, 0)
    places = torch.where(mask, mask.cumsum(0) - 1, total)  # the others are written past the end
    indices = owners.new_empty(total + 1).scatter_(0, places, torch.arange(len(mask), device=mask.device))[:total]
    return indices, functional.pad(counts.cumsum(0), (1, 0)), longest


class ReferenceMarch(March):
    """The march in PyTorch, for any device: it finds all candidates first, and returns them wave by wave.

    `rays`, `occupancy`, `step`, `cone`, `shift` and `early_stop` are as in `march`.
    """

    def __init__(
        self, rays: Rays, occupancy: Occupancy, step: float, cone: float, shift: Tensor | None, early_stop: float
    ) -> None:
        super().__init__(rays, early_stop)
        found = candidates(rays, occupancy, step, cone, shift)
        self.t_starts, self.t_ends, self.owners, self.offsets, self._most = found
        self.longest, self._in_wave = self._most, 0
        self.spent = rays.origins.new_zeros(len(rays))
        self.alive: Tensor | None = None
        """(A,) active rays; None before the first wave, and after a wave with all candidates."""
        self.num_returned = 0

    @property
    def next_limit(self) -> int:
        if self.num_returned == 0 and len(self.t_starts) <= CAPACITY:
            return self._most
        return max(CAPACITY // max(len(self.rays if self.alive is None else self.alive), 1), WAVES[0])

    def wave(self, limit: int) -> Wave | None:
        if self.num_returned >= self._most:
            return None
        if limit >= self._most and self.num_returned == 0:
            starts, ends, owners = self.t_starts, self.t_ends, self.owners
            self.ranks = torch.arange(len(owners), device=owners.device) - self.offsets.index_select(0, owners)
        else:
            counts = self.offsets.diff()
            self.alive = counts.nonzero().squeeze(-1) if self.alive is None else self.alive
            if len(self.alive) == 0:
                return None
            left = counts.index_select(0, self.alive) - self.num_returned
            numbers, self.ranks = ranges(left.clamp(max=limit))
            owners = self.alive.index_select(0, numbers)
            chosen = self.offsets.index_select(0, owners) + self.num_returned + self.ranks
            starts, ends = self.t_starts.index_select(0, chosen), self.t_ends.index_select(0, chosen)
        self.num_returned += limit
        self._in_wave = min(limit, self._most)
        wave = Wave(starts, ends, owners, self.rays.points(owners, (starts + ends) / 2))
        self.waves.append(wave)
        return wave

    @torch.no_grad()
    def advance(self, sigma: Tensor) -> None:
        wave = self.waves[-1]
        tau = optical_depth(sigma.detach().to(self.spent.dtype), wave.t_ends - wave.t_starts)
        before = bounded_sum(tau, wave.owners, self.ranks, len(self.rays), self._in_wave)
        if self.alive is not None:
            before = self.spent.index_select(0, wave.owners) + before
        self.reached.append((~(before >= self.budget)).to(torch.uint8))
        self.spent.index_add_(0, wave.owners, tau)
        if self.alive is None:
            return
        remaining = self.offsets.diff().index_select(0, self.alive) > self.num_returned
        going_on = remaining & ~(self.spent.index_select(0, self.alive) >= self.budget)
        self.alive = self.alive.index_select(0, going_on.nonzero().squeeze(-1))

    def finish(self) -> tuple[Tensor, Tensor]:
        if self.alive is not None or self.rested or not self.waves:
            return super().finish()
        # The samples of a single wave are already sorted.
        order, offsets, self.longest = _chosen(self.reached[0] > 0, self.owners, len(self.rays))
        return order, offsets


def march(rays: Rays, occupancy: Occupancy, step: float, cone: float, shift: Tensor | None, early_stop: float) -> March:
    """Start a march of rays through the occupied cells of a grid.

    Args:
        rays: R rays.
        occupancy: the grid, of one or several boxes, or with time slices; rays then need times.
        step: length of a step near the camera, scene units.
        cone: growth of a step per unit of distance; 0 for even steps.
        shift: (R,) fraction of the first step that is before the box; None for 0.
        early_stop: transmittance below which a ray ends; 0 for never.
    """
    tensors = rays.origins, rays.directions, rays.nears, rays.fars, occupancy.box
    return MARCH(tensors, rays, occupancy, step, cone, shift, early_stop)


MARCH: Operation[..., March] = Operation("march", ReferenceMarch)
MARCH.implementation(CPP)(CompiledMarch)
MARCH.implementation(TRITON)(later("march.waves_triton", "TritonMarch"))


def step_start(first: Tensor, k: Tensor, step: float, cone: float) -> Tensor:
    """Return the distances (N,) where steps `k` (N,) start on rays with step 0 at `first` (N,).

    Steps have the length `step` while it exceeds `cone` * t, and then grow by the factor 1 + `cone`.
    """
    k = k.to(first.dtype)
    even = first + k * step
    if cone == 0:
        return even
    turn = ((step / cone - first).clamp(min=0) / step).ceil()
    return torch.where(k <= turn, even, (first + turn * step) * (1 + cone) ** (k - turn))


def step_range(
    rays: Rays, occupancy: Occupancy, step: float, cone: float, shift: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the distances where rays enter and leave the grid, and of their first step, and the numbers of steps.

    `rays`, `occupancy`, `step`, `cone` and `shift` are as in `march`.

    Returns:
        Three distances (R,), and numbers (R,) int64, 0 for rays that miss the grid.
    """
    enter, leave = intersect_box(rays.origins, rays.directions, occupancy.outer)
    enter, leave = torch.maximum(enter, rays.nears), torch.minimum(leave, rays.fars)
    first = enter if shift is None else enter - shift * step
    counts = ((leave - first) / step).ceil()
    if cone:
        turn = ((step / cone - first).clamp(min=0) / step).ceil()
        base = first + turn * step
        grown = turn + ((leave / base).clamp(min=1).log() / math.log1p(cone)).ceil() + 1
        counts = torch.where(counts > turn, torch.minimum(counts, grown), counts)
    counts = torch.where(leave > enter, counts.clamp(min=0), torch.zeros_like(counts)).long()
    return enter, leave, first, counts


@torch.no_grad()
def candidates(
    rays: Rays, occupancy: Occupancy, step: float, cone: float, shift: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor, int]:
    """Return all steps with their middle in an occupied cell.

    `rays`, `occupancy`, `step`, `cone` and `shift` are as in `march`.

    Returns:
        Starts (N,), ends (N,) and rays (N,) of the steps, sorted by ray; offsets (R + 1,) of the rays; and the maximum
        number of steps on a ray.
    """
    enter, leave, first, counts = step_range(rays, occupancy, step, cone, shift)
    runs_together = cone == 0 and occupancy.levels == 1
    run = RUN if runs_together else 1
    # Waits for the device three times: for the number of runs, of runs near an occupied cell, and of candidates.
    runs = (counts + run - 1) // run
    owners, k = ranges(runs)
    if runs_together:
        owners, k = _near_occupied(rays, occupancy, step, first, owners, k)
    starts, ends = (step_start(first.index_select(0, owners), k + after, step, cone) for after in (0, 1))
    middle = (starts + ends) / 2
    cells = occupancy.cells(rays.points(owners, middle), _of_rays(occupancy.slices_of(rays.times), owners))
    inside = (middle >= enter.index_select(0, owners)) & (middle < leave.index_select(0, owners))
    kept, offsets, longest = _chosen(occupancy.occupied.index_select(0, cells) & inside, owners, len(rays))
    starts, ends, owners = (values.index_select(0, kept) for values in (starts, ends, owners))
    return starts, ends, owners, offsets, longest


def _near_occupied(
    rays: Rays, occupancy: Occupancy, step: float, first: Tensor, owners: Tensor, run: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the rays and numbers of the steps near an occupied cell, in runs of RUN steps each.

    `owners` and `run` are ray and index of each run; `rays`, `occupancy`, `step` and `first` are as in `candidates`.
    """
    reach = occupancy.near(math.ceil((RUN - 1) / 2 * step / occupancy.edge))
    middle = first.index_select(0, owners) + (run * RUN + RUN / 2) * step
    cells = occupancy.cells(rays.points(owners, middle), _of_rays(occupancy.slices_of(rays.times), owners))
    kept = reach.index_select(0, cells).nonzero().squeeze(-1)
    owners, run = owners.index_select(0, kept), run.index_select(0, kept)
    k = run[:, None] * RUN + torch.arange(RUN, device=run.device)
    return owners.repeat_interleave(RUN), k.reshape(-1)


def _of_rays(values: Tensor | None, owners: Tensor) -> Tensor | None:
    """Return the value (N,) of the ray of each of `owners` (N,); None if rays have none."""
    return None if values is None else values.index_select(0, owners)


def ranges(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Return the owner (N,) and rank (N,) of each item, where owner i has `counts[i]` items, ranked from 0."""
    owners = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)
    firsts = counts.cumsum(0) - counts
    return owners, torch.arange(len(owners), device=counts.device) - firsts.index_select(0, owners)


_begin: Callable[..., int] = native.Function("march_begin", "pppppqpfppppi", "q")
_wave: Callable[..., int] = native.Function("march_wave", "ppppppppqipffppiipppppi", "q")
_advance: Callable[..., int] = native.Function("march_advance", "pqpipppfppp", "q")

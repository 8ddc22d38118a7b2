"""Marching of rays through an occupancy grid, in waves.

The candidates of a ray are the steps first + k * step, which grow with distance beyond step / cone (Instant-NGP,
Mueller et al. 2022, appendix E.1). Candidates whose middle lies in an occupied cell are samples. A wave consists of the
next few samples of every ray that has not ended. When their density is known, `advance` ends rays whose transmittance
is low, so that hidden samples are never evaluated, and no sample is evaluated twice.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn import functional

from framework.geometry.bounds import intersect_box
from framework.geometry.rays import Rays
from framework.kernels import native
from framework.kernels.compositing import optical_depth, segmented_sum
from framework.kernels.dispatch import CPP, INT64, TRITON, Operation
from framework.kernels.given import check_indices
from framework.kernels.triton_kernels import later

BLOCK = 4
"""Cells along an edge of a block, which is a cell of the coarser level."""
RUN = 8
"""Number of steps that the reference tests together."""
ROUNDING = 1e-5
"""Relative tolerance of the mean opacity, so that rounding errors do not empty a grid whose cells are all equal."""


@dataclass(frozen=True)
class Occupancy:
    """The occupied cells of a grid over a box."""

    occupied: Tensor
    """(n^3,) bool; the index of cell (x, y, z) is (x n + y) n + z."""
    box: Tensor
    """(2, 3) minimum and maximum corner, scene units."""
    resolution: int
    """Number n of cells along each axis."""

    @cached_property
    def packed(self) -> tuple[Tensor, Tensor]:
        """(ceil(n^3 / 8),) uint8 with one bit per cell, and (ceil(n / 4)^3,) uint8, for the compiled march.

        The second tensor has, for each block of 4^3 cells, the distance in blocks to the nearest block with an occupied
        cell.
        """
        bits = torch.empty((self.resolution**3 + 7) // 8, dtype=torch.uint8)
        blocks = torch.empty(math.ceil(self.resolution / BLOCK) ** 3, dtype=torch.uint8)
        address = native.pointer(self.occupied, "the occupancy", (self.resolution**3,), torch.bool)
        _pack(address, self.resolution, bits.data_ptr(), blocks.data_ptr())
        return bits, blocks

    @cached_property
    def distances(self) -> Tensor:
        """(ceil(n / 4)^3,) uint8 distances of blocks, as in `packed`, but at most 16, for the march on a GPU."""
        return later("march", "block_distances")(self.occupied, self.resolution)

    def cells(self, positions: Tensor) -> Tensor:
        """Return the index (N,) of the cell of each of `positions` (N, 3), or of the nearest cell if it is outside."""
        scale = self.resolution / (self.box[1] - self.box[0])
        x, y, z = ((positions - self.box[0]) * scale).long().clamp(0, self.resolution - 1).unbind(-1)
        return (x * self.resolution + y) * self.resolution + z


def refresh_occupancy_reference(density: Tensor, occupied: Tensor, decay: float, step: float, threshold: float) -> None:
    """Compute `refresh_occupancy` of `density`, `occupied`, `decay`, `step` and `threshold` in PyTorch."""
    density *= decay
    alpha = -torch.expm1(-density * step)
    least = min(threshold, alpha.nanmean().item() * (1 - ROUNDING))  # the threshold if all are NaN
    occupied.copy_(~(alpha < least))


@torch.no_grad()
def refresh_occupancy(density: Tensor, occupied: Tensor, decay: float, step: float, threshold: float) -> None:
    """Mark, in place, the cells whose opacity over one step is at least a threshold.

    Args:
        density: (n^3,) density of each cell, 1/length, which is multiplied by `decay` in place; infinite if unknown.
            Cells of NaN are marked, so that a broken field is noticed, and left out of the mean.
        occupied: (n^3,) bool, to be written.
        decay: factor of the densities.
        step: length of a step, scene units.
        threshold: minimum opacity, or the mean opacity over all cells if that is less.
    """
    REFRESH_OCCUPANCY((density,), density, occupied, decay, step, threshold)


REFRESH_OCCUPANCY = Operation("refresh_occupancy", refresh_occupancy_reference)


@REFRESH_OCCUPANCY.implementation(CPP)
def _refresh_compiled(density: Tensor, occupied: Tensor, decay: float, step: float, threshold: float) -> None:
    cells = len(density)
    _refresh(
        native.pointer(density, "density", (cells,)), cells, decay, step, threshold,
        native.pointer(occupied, "the occupancy", (cells,), torch.bool), native.threads(),
    )  # fmt: skip


@dataclass(frozen=True)
class Wave:
    """N samples that are evaluated together."""

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
        """(N,) uint8 for each wave: 1 for samples in front of which the transmittance is not below `early_stop`."""

    @abstractmethod
    def wave(self, limit: int) -> Wave | None:
        """Return up to `limit` samples on each ray that has not ended; None if all have."""

    @abstractmethod
    def advance(self, sigma: Tensor) -> None:
        """End rays whose transmittance is low or that have left the box, by the density `sigma` (N,) of the wave."""

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
        self.step, self.cone, self.resolution = step, cone, occupancy.resolution
        self.bits, self.blocks = occupancy.packed
        self.origins, self.directions = rays.origins.contiguous(), rays.directions.contiguous()
        self.enter, self.leave, self.first = (torch.empty(count) for _ in range(3))
        self.box = occupancy.box.contiguous()
        alive = torch.empty(count, dtype=torch.int64)
        nears, fars = rays.nears.contiguous(), rays.fars.contiguous()
        shift = None if shift is None else shift.contiguous()
        hits = _begin(
            native.pointer(self.origins, "ray origins", (count, 3)),
            native.pointer(self.directions, "ray directions", (count, 3)),
            native.pointer(nears, "nears", (count,)), native.pointer(fars, "fars", (count,)),
            None if shift is None else native.pointer(shift, "the shift", (count,)), count,
            native.pointer(self.box, "the box", (2, 3)), step, self.enter.data_ptr(), self.leave.data_ptr(),
            self.first.data_ptr(), alive.data_ptr(), native.threads(),
        )  # fmt: skip
        self.alive = alive[:hits]
        self.next = torch.zeros(count, dtype=torch.int32)
        self.spent = torch.zeros(count)

    def wave(self, limit: int) -> Wave | None:
        living, room = len(self.alive), len(self.alive) * limit
        if living == 0:
            return None
        self.counts, self.limit = torch.empty(living, dtype=torch.int32), limit
        starts, ends, positions = torch.empty(room), torch.empty(room), torch.empty(room, 3)
        owners = torch.empty(room, dtype=torch.int64)
        count = _wave(
            self.origins.data_ptr(), self.directions.data_ptr(), self.enter.data_ptr(), self.leave.data_ptr(),
            self.first.data_ptr(), self.next.data_ptr(), self.alive.data_ptr(), living, limit, self.box.data_ptr(),
            self.step, self.cone, self.bits.data_ptr(), self.blocks.data_ptr(), self.resolution, self.counts.data_ptr(),
            starts.data_ptr(), ends.data_ptr(), owners.data_ptr(), positions.data_ptr(), native.threads(),
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


def sort_by_ray(owners: Tensor, reached: Tensor, num_rays: int) -> tuple[Tensor, Tensor]:
    """Return the order (M,) that sorts the reached samples by ray, stably, and the offsets (R + 1,) of the rays.

    Args:
        owners: (N,) int64 index of the ray of each sample.
        reached: (N,) uint8, not 0 for samples that are kept.
        num_rays: number R of rays.

    Raises:
        IndexError: if an index of a ray is out of range.
    """
    return SORT_BY_RAY((owners,), owners, reached, num_rays)


def sort_by_ray_reference(owners: Tensor, reached: Tensor, num_rays: int) -> tuple[Tensor, Tensor]:
    """Compute `sort_by_ray` of `owners`, `reached` and `num_rays` in PyTorch, on any device."""
    check_indices(owners, num_rays, "rays")
    chosen = reached.nonzero().squeeze(-1)
    order = chosen[owners[chosen].argsort(stable=True)]
    counts = torch.bincount(owners[chosen], minlength=num_rays)
    return order, functional.pad(counts.cumsum(0), (1, 0))


SORT_BY_RAY = Operation("sort_by_ray", sort_by_ray_reference)


@SORT_BY_RAY.implementation(CPP, types=INT64)
def _sort_by_ray(owners: Tensor, reached: Tensor, num_rays: int) -> tuple[Tensor, Tensor]:
    order, offsets = torch.empty_like(owners), torch.empty(num_rays + 1, dtype=torch.int64)
    count = len(owners)
    kept = _sort(
        native.pointer(owners, "owners", (count,), torch.int64),
        native.pointer(reached, "reached", (count,), torch.uint8), count, num_rays, order.data_ptr(),
        offsets.data_ptr(),
    )  # fmt: skip
    return order[:kept], offsets


class ReferenceMarch(March):
    """The march in PyTorch, for any device: it finds all candidates first, and returns them wave by wave.

    `rays`, `occupancy`, `step`, `cone`, `shift` and `early_stop` are as in `march`.
    """

    def __init__(
        self, rays: Rays, occupancy: Occupancy, step: float, cone: float, shift: Tensor | None, early_stop: float
    ) -> None:
        super().__init__(rays, early_stop)
        self.t_starts, self.t_ends, self.offsets = candidates(rays, occupancy, step, cone, shift)
        self.counts = self.offsets[1:] - self.offsets[:-1]
        self.spent = rays.origins.new_zeros(len(rays))
        self.alive = self.counts.nonzero().squeeze(-1)
        self.num_returned = 0

    def wave(self, limit: int) -> Wave | None:
        if len(self.alive) == 0:
            return None
        ray_numbers, self.ranks = ranges((self.counts[self.alive] - self.num_returned).clamp(max=limit))
        owners = self.alive[ray_numbers]
        chosen = self.offsets[:-1][owners] + self.num_returned + self.ranks
        starts, ends = self.t_starts[chosen], self.t_ends[chosen]
        self.num_returned += limit
        wave = Wave(starts, ends, owners, self.rays.points(owners, (starts + ends) / 2))
        self.waves.append(wave)
        return wave

    @torch.no_grad()
    def advance(self, sigma: Tensor) -> None:
        wave = self.waves[-1]
        tau = optical_depth(sigma.detach().to(self.spent.dtype), wave.t_ends - wave.t_starts)
        before = self.spent[wave.owners] + segmented_sum(tau, self.ranks)
        self.reached.append((~(before >= self.budget)).to(torch.uint8))
        self.spent.index_add_(0, wave.owners, tau)
        remaining = self.counts[self.alive] > self.num_returned
        self.alive = self.alive[remaining & ~(self.spent[self.alive] >= self.budget)]


def march(rays: Rays, occupancy: Occupancy, step: float, cone: float, shift: Tensor | None, early_stop: float) -> March:
    """Start a march of rays through the occupied cells of a grid.

    Args:
        rays: R rays.
        occupancy: the grid.
        step: length of a step near the camera, scene units.
        cone: growth of a step per unit of distance; 0 for even steps.
        shift: (R,) fraction of a step by which the first step starts in front of the box; None for 0.
        early_stop: transmittance below which a ray ends; 0 for never.
    """
    tensors = rays.origins, rays.directions, rays.nears, rays.fars, occupancy.box
    return MARCH(tensors, rays, occupancy, step, cone, shift, early_stop)


MARCH: Operation[..., March] = Operation("march", ReferenceMarch)
MARCH.implementation(CPP)(CompiledMarch)
MARCH.implementation(TRITON)(later("march", "TritonMarch"))
SORT_BY_RAY.implementation(TRITON, types=INT64)(later("march", "sort_by_ray"))


def step_start(first: Tensor, k: Tensor, step: float, cone: float) -> Tensor:
    """Return the distances (N,) at which steps `k` (N,) start on rays whose step 0 starts at `first` (N,).

    Steps have the length `step` while it exceeds `cone` * t, and then grow by the factor 1 + `cone`.
    """
    k = k.to(first.dtype)
    even = first + k * step
    if cone == 0:
        return even
    turn = ((step / cone - first).clamp(min=0) / step).ceil()
    return torch.where(k <= turn, even, (first + turn * step) * (1 + cone) ** (k - turn))


@torch.no_grad()
def candidates(
    rays: Rays, occupancy: Occupancy, step: float, cone: float, shift: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the starts (N,), ends (N,) and offsets (R + 1,) of all steps whose middle is in an occupied cell.

    `rays`, `occupancy`, `step`, `cone` and `shift` are as in `march`.
    """
    enter, leave = intersect_box(rays.origins, rays.directions, occupancy.box)
    enter, leave = torch.maximum(enter, rays.nears), torch.minimum(leave, rays.fars)
    first = enter if shift is None else enter - shift * step
    counts = ((leave - first) / step).ceil()
    if cone:
        turn = ((step / cone - first).clamp(min=0) / step).ceil()
        base = first + turn * step
        grown = turn + ((leave / base).clamp(min=1).log() / math.log1p(cone)).ceil() + 1
        counts = torch.where(counts > turn, torch.minimum(counts, grown), counts)
    counts = torch.where(leave > enter, counts.clamp(min=0), torch.zeros_like(counts)).long()
    owners, k = ranges(counts)
    if cone == 0:
        owners, k = _near_occupied(rays, occupancy, step, first, counts)
    starts, ends = (step_start(first[owners], k + after, step, cone) for after in (0, 1))
    middle = (starts + ends) / 2
    cells = occupancy.cells(rays.points(owners, middle))
    keep = occupancy.occupied[cells] & (middle >= enter[owners]) & (middle < leave[owners])
    per_ray = torch.bincount(owners[keep], minlength=len(rays))
    return starts[keep], ends[keep], functional.pad(per_ray.cumsum(0), (1, 0))


def _near_occupied(
    rays: Rays, occupancy: Occupancy, step: float, first: Tensor, counts: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the rays and numbers of the steps in those runs of RUN steps that are near an occupied cell."""
    cell = ((occupancy.box[1] - occupancy.box[0]) / occupancy.resolution).min().item()
    reach = dilated(occupancy, math.ceil((RUN - 1) / 2 * step / cell))
    owners, run = ranges((counts + RUN - 1) // RUN)
    middle = first[owners] + (run * RUN + RUN / 2) * step
    keep = reach[occupancy.cells(rays.points(owners, middle))]
    owners, run = owners[keep], run[keep]
    k = run[:, None] * RUN + torch.arange(RUN, device=run.device)
    return owners.repeat_interleave(RUN), k.reshape(-1)


def dilated(occupancy: Occupancy, radius: int) -> Tensor:
    """Return the cells (n^3,) bool of `occupancy` that have an occupied cell within `radius` cells along every axis."""
    n = occupancy.resolution
    grid = occupancy.occupied.view(n, n, n)
    for axis in range(3):
        out = grid.clone()
        for shift in range(1, min(radius, n - 1) + 1):
            out.narrow(axis, 0, n - shift).logical_or_(grid.narrow(axis, shift, n - shift))
            out.narrow(axis, shift, n - shift).logical_or_(grid.narrow(axis, 0, n - shift))
        grid = out
    return grid.reshape(-1)


def ranges(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Return the owner (N,) and rank (N,) of each item, where owner i has `counts[i]` items, ranked from 0."""
    owners = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)
    firsts = counts.cumsum(0) - counts
    return owners, torch.arange(len(owners), device=counts.device) - firsts[owners]


_pack: Callable[..., None] = native.Function("pack_occupancy", "pipp")
_refresh: Callable[..., None] = native.Function("refresh_occupancy", "pqfffpi")
_begin: Callable[..., int] = native.Function("march_begin", "pppppqpfppppi", "q")
_wave: Callable[..., int] = native.Function("march_wave", "pppppppqipffppipppppi", "q")
_advance: Callable[..., int] = native.Function("march_advance", "pqpipppfppp", "q")
_sort: Callable[..., int] = native.Function("sort_by_ray", "ppqqpp", "q")

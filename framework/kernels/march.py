"""Marching rays through an occupancy grid, in waves.

A ray's candidates are the steps first + k * step, growing with distance beyond step / cone (Instant-NGP, Mueller et
al. 2022, appendix E.1); those whose middle lies in an occupied cell are samples. A wave hands out the next few samples
of every ray on which light is left; when their density is known, `advance` decides who goes on. So hidden samples are
never evaluated, and none is evaluated twice.
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
from framework.kernels.dispatch import CPP, INT64, Operation
from framework.kernels.given import check_indices

BLOCK = 4
"""Cells along an edge of a block of the coarser level."""
RUN = 8
"""Steps that the reference tests together."""
ROUNDING = 1e-5
"""By how much, relatively, a mean of equal opacities may exceed them: cells that are all alike are not empty."""


@dataclass(frozen=True)
class Occupancy:
    """Which cells of a box are not empty."""

    occupied: Tensor
    """(n^3,) bool, the cell's index being (x n + y) n + z."""
    box: Tensor
    """(2, 3) smallest and largest corner."""
    resolution: int
    """n, cells along each axis."""

    @cached_property
    def packed(self) -> tuple[Tensor, Tensor]:
        """What the compiled march reads, made at the first one.

        Returns: (n^3 / 8,) uint8, one bit a cell; (ceil(n / 4)^3,) uint8, how many blocks of 4^3 cells away the nearest
            with an occupied one is.
        """
        bits = torch.empty((self.resolution**3 + 7) // 8, dtype=torch.uint8)
        blocks = torch.empty(math.ceil(self.resolution / BLOCK) ** 3, dtype=torch.uint8)
        address = native.pointer(self.occupied, "the occupancy", (self.resolution**3,), torch.bool)
        _pack(address, self.resolution, bits.data_ptr(), blocks.data_ptr())
        return bits, blocks

    def cells(self, positions: Tensor) -> Tensor:
        """Index (N,) of the cell each position (N, 3) lies in; outside positions go to the nearest cell."""
        scale = self.resolution / (self.box[1] - self.box[0])
        x, y, z = ((positions - self.box[0]) * scale).long().clamp(0, self.resolution - 1).unbind(-1)
        return (x * self.resolution + y) * self.resolution + z


def refresh_occupancy_reference(density: Tensor, occupied: Tensor, decay: float, step: float, threshold: float) -> None:
    """As `refresh_occupancy`, in torch, on any device."""
    density *= decay
    alpha = -torch.expm1(-density * step)
    least = min(threshold, alpha.nanmean().item() * (1 - ROUNDING))  # the threshold where all are NaN
    occupied.copy_(~(alpha < least))


@torch.no_grad()
def refresh_occupancy(density: Tensor, occupied: Tensor, decay: float, step: float, threshold: float) -> None:
    """Mark, in place, the cells whose opacity over one step is at least `threshold`, or the mean if that is less.

    Args:
        density: (n^3,) what is known of each cell, multiplied by `decay` first; infinite where nothing is. A cell of
            NaN is marked, so that a broken field is seen, and left out of the mean.
        occupied: (n^3,) bool, written.
        step: length of a step, scene units.
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
    """Samples that are evaluated together."""

    t_starts: Tensor
    """(N,)"""
    t_ends: Tensor
    """(N,)"""
    owners: Tensor
    """(N,) int64, the ray of each."""
    positions: Tensor
    """(N, 3) the middles."""

    @property
    def t(self) -> Tensor:
        """(N,) distances of the middles."""
        return (self.t_starts + self.t_ends) / 2


class March(ABC):
    """Rays on their way through the grid: `wave` and `advance` in turn until `wave` returns None, then `finish`.

    Args:
        rays: R rays.
        early_stop: transmittance under which a ray ends.
    """

    def __init__(self, rays: Rays, early_stop: float) -> None:
        self.rays = rays
        self.budget = -math.log(early_stop) if early_stop > 0 else math.inf
        self.waves: list[Wave] = []
        self.reached: list[Tensor] = []
        """(N,) uint8 of each wave: the samples that light reached."""

    @abstractmethod
    def wave(self, limit: int) -> Wave | None:
        """Up to `limit` samples on each ray that is alive; None where no ray is."""

    @abstractmethod
    def advance(self, sigma: Tensor) -> None:
        """The density (N,) of the last wave is known: rays whose light is spent, or that left the box, end."""

    def finish(self) -> tuple[Tensor, Tensor]:
        """Order (M,) that puts the samples of all waves which light reached ray by ray, and offsets (R + 1,)."""
        if not self.waves:
            counts = self.rays.nears.new_zeros(len(self.rays) + 1, dtype=torch.int64)
            return counts[:0], counts
        owners = torch.cat([wave.owners for wave in self.waves])
        return sort_by_ray(owners, torch.cat(self.reached), len(self.rays))


class CompiledMarch(March):
    """The march in C++: rays on the CPU, float32. Arguments as for `march`."""

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
        found = _wave(
            self.origins.data_ptr(), self.directions.data_ptr(), self.enter.data_ptr(), self.leave.data_ptr(),
            self.first.data_ptr(), self.next.data_ptr(), self.alive.data_ptr(), living, limit, self.box.data_ptr(),
            self.step, self.cone, self.bits.data_ptr(), self.blocks.data_ptr(), self.resolution, self.counts.data_ptr(),
            starts.data_ptr(), ends.data_ptr(), owners.data_ptr(), positions.data_ptr(), native.threads(),
        )  # fmt: skip
        wave = Wave(starts[:found], ends[:found], owners[:found], positions[:found])
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
    """Order (M,) of those of N samples that are `reached`, by their ray and otherwise as they stand; offsets (R + 1,).

    Args:
        owners: (N,) int64.
        reached: (N,) uint8.
    Raises: IndexError where there is no such ray.
    """
    return SORT_BY_RAY((owners,), owners, reached, num_rays)


def sort_by_ray_reference(owners: Tensor, reached: Tensor, num_rays: int) -> tuple[Tensor, Tensor]:
    """As `sort_by_ray`, in torch, on any device."""
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
    """The march in torch, on any device: all candidates are found first, and handed out wave by wave.

    Arguments as for `march`.
    """

    def __init__(
        self, rays: Rays, occupancy: Occupancy, step: float, cone: float, shift: Tensor | None, early_stop: float
    ) -> None:
        super().__init__(rays, early_stop)
        self.t_starts, self.t_ends, self.offsets = candidates(rays, occupancy, step, cone, shift)
        self.counts = self.offsets[1:] - self.offsets[:-1]
        self.spent = rays.origins.new_zeros(len(rays))
        self.alive = self.counts.nonzero().squeeze(-1)
        self.handed_out = 0

    def wave(self, limit: int) -> Wave | None:
        if len(self.alive) == 0:
            return None
        ranks, self.places = ranges((self.counts[self.alive] - self.handed_out).clamp(max=limit))
        owners = self.alive[ranks]
        chosen = self.offsets[:-1][owners] + self.handed_out + self.places
        starts, ends = self.t_starts[chosen], self.t_ends[chosen]
        self.handed_out += limit
        wave = Wave(starts, ends, owners, self.rays.points(owners, (starts + ends) / 2))
        self.waves.append(wave)
        return wave

    @torch.no_grad()
    def advance(self, sigma: Tensor) -> None:
        wave = self.waves[-1]
        tau = optical_depth(sigma.detach().to(self.spent.dtype), wave.t_ends - wave.t_starts)
        before = self.spent[wave.owners] + segmented_sum(tau, self.places)
        self.reached.append((~(before >= self.budget)).to(torch.uint8))
        self.spent.index_add_(0, wave.owners, tau)
        self.alive = self.alive[(self.counts[self.alive] > self.handed_out) & ~(self.spent[self.alive] >= self.budget)]


def march(rays: Rays, occupancy: Occupancy, step: float, cone: float, shift: Tensor | None, early_stop: float) -> March:
    """March rays through the occupied cells of a grid.

    Args:
        rays: R rays.
        occupancy: the grid.
        step: length of a step near the camera, scene units.
        cone: growth of a step per unit of distance; 0 for even steps.
        shift: (R,) share of a step by which the first one starts before the box; None for 0.
        early_stop: transmittance under which a ray ends.
    """
    tensors = rays.origins, rays.directions, rays.nears, rays.fars, occupancy.box
    return MARCH(tensors, rays, occupancy, step, cone, shift, early_stop)


MARCH: Operation[..., March] = Operation("march", ReferenceMarch)
MARCH.implementation(CPP)(CompiledMarch)


def step_start(first: Tensor, k: Tensor, step: float, cone: float) -> Tensor:
    """Where step k (N,) of rays that begin at `first` (N,) starts: even while step > cone * t, then geometric."""
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
    """All steps of R rays whose middle lies in an occupied cell: starts (N,), ends (N,), offsets (R + 1,)."""
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
    """Owners and numbers of the steps in those runs of RUN that come near an occupied cell."""
    cell = ((occupancy.box[1] - occupancy.box[0]) / occupancy.resolution).min().item()
    reach = dilated(occupancy, math.ceil((RUN - 1) / 2 * step / cell))
    owners, run = ranges((counts + RUN - 1) // RUN)
    middle = first[owners] + (run * RUN + RUN / 2) * step
    keep = reach[occupancy.cells(rays.points(owners, middle))]
    owners, run = owners[keep], run[keep]
    k = run[:, None] * RUN + torch.arange(RUN, device=run.device)
    return owners.repeat_interleave(RUN), k.reshape(-1)


def dilated(occupancy: Occupancy, radius: int) -> Tensor:
    """(n^3,) bool: cells with an occupied one within `radius` along every axis."""
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
    """Owner (N,) and rank (N,) of each item when owner i has counts[i] of them: 0 .. counts[i] - 1."""
    owners = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)
    firsts = counts.cumsum(0) - counts
    return owners, torch.arange(len(owners), device=counts.device) - firsts[owners]


_pack: Callable[..., None] = native.Function("pack_occupancy", "pipp")
_refresh: Callable[..., None] = native.Function("refresh_occupancy", "pqfffpi")
_begin: Callable[..., int] = native.Function("march_begin", "pppppqpfppppi", "q")
_wave: Callable[..., int] = native.Function("march_wave", "pppppppqipffppipppppi", "q")
_advance: Callable[..., int] = native.Function("march_advance", "pqpipppfppp", "q")
_sort: Callable[..., int] = native.Function("sort_by_ray", "ppqqpp", "q")

"""Marching into a fixed number of slots, so that Python need not know how many samples there are.

Reading the number of samples from a GPU would make it wait for Python. Here the number of slots is fixed, and only the
device counts. Unused slots are distributed among the rays, after their samples, as intervals of length 0, which stop no
light and have no gradient. So later operations need no special case. If the slots do not suffice, whole rays are
dropped, from the end of the batch, and counted.

Letters: R rays, C slots.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from nerfloom.geometry.rays import Rays
from nerfloom.kernels.compositing.density import bounded_sum, optical_depth
from nerfloom.kernels.dispatch import TRITON, Operation
from nerfloom.kernels.march.occupancy import Occupancy
from nerfloom.kernels.march.waves import RUN, _of_rays, step_range
from nerfloom.kernels.triton_backend import later


@dataclass(frozen=True)
class Slots:
    """C slots distributed among R rays: first the slots with a ray's items, then empty ones."""

    owners: Tensor
    """(C,) int64 ray of each slot, in ascending order."""
    ranks: Tensor
    """(C,) int64 number of slots before each on its ray."""
    offsets: Tensor
    """(R + 1,) int64 first slot of each ray; the last entry is C."""
    counts: Tensor
    """(R,) int64 items of each ray; 0 if the ray was dropped."""
    left_out: Tensor
    """() int64 number of rays dropped: no slot left."""


def share_out(counts: Tensor, capacity: int) -> Slots:
    """Distribute slots among rays.

    Args:
        counts: (R,) int64 items of each ray, R > 0.
        capacity: number C of slots, more than 0.
    """
    rays, device = len(counts), counts.device
    fits = counts.cumsum(0) <= capacity
    held = torch.where(fits, counts, 0)
    ends = functional.pad(held.cumsum(0), (1, 0))
    offsets = ends + (capacity - ends[-1]) * torch.arange(rays + 1, device=device) // rays
    slots = torch.arange(capacity, device=device)
    owners = torch.searchsorted(offsets[1:].contiguous(), slots, right=True)
    ranks = slots - offsets.index_select(0, owners)
    return Slots(owners, ranks, offsets, held, (~fits).sum())


@dataclass(frozen=True)
class Placed:
    """Intervals along rays in slots.

    Intervals of empty slots have length 0. They are at the end of the ray's last interval, or at 0 on a ray without
    any.
    """

    slots: Slots
    """The slots."""
    t_starts: Tensor
    """(C,) distance at the start of each interval."""
    t_ends: Tensor
    """(C,) distance at the end of each interval."""

    @classmethod
    def of(cls, starts: Tensor, ends: Tensor, firsts: Tensor, slots: Slots) -> Placed:
        """Place intervals into slots.

        Args:
            starts: (N,) distance at the start of each interval, finite; N > 0.
            ends: (N,) distance at the end of each interval, finite.
            firsts: (R,) int64 index of the first interval of each ray; the intervals of a ray are consecutive.
            slots: slots for that many intervals of each ray.
        """
        held = slots.counts.index_select(0, slots.owners)
        places = firsts.index_select(0, slots.owners) + torch.minimum(slots.ranks, held - 1).clamp(min=0)
        places = places.clamp(max=len(starts) - 1)
        its_ends = torch.where(held > 0, ends.index_select(0, places), 0)
        its_starts = torch.where(slots.ranks < held, starts.index_select(0, places), its_ends)
        return cls(slots, its_starts, its_ends)

    def first(self, counts: Tensor, capacity: int) -> Placed:
        """Return the first `counts` (R,) intervals of each ray in `capacity` slots."""
        slots = share_out(counts, capacity)
        return Placed.of(self.t_starts, self.t_ends, self.slots.offsets[:-1], slots)


@dataclass(frozen=True)
class Filled:
    """The candidates of a march in slots, and the required capacity."""

    placed: Placed
    """The candidates."""
    runs: Tensor
    """() int64 number of runs of steps near an occupied cell; 0 if runs need no capacity."""
    candidates: Tensor
    """() int64 number of candidates on all rays that had slots for their runs."""
    left_out: Tensor
    """() int64 number of dropped rays."""


def most_steps(num_steps: int) -> int:
    """Return the maximum number of steps on a ray through a box with a diagonal of `num_steps` steps."""
    return num_steps + 2  # one is cut off at each end


@torch.no_grad()
def fill(
    rays: Rays, occupancy: Occupancy, step: float, num_steps: int, shift: Tensor | None, capacities: tuple[int, int]
) -> Filled:
    """Return the steps of rays with their middle in an occupied cell, in a fixed number of slots.

    They are the steps of `nerfloom.kernels.march.waves.candidates`, for even steps.

    Args:
        rays: R rays, R > 0.
        occupancy: the grid, of one box, or with time slices; rays then need times.
        step: length of a step, scene units.
        num_steps: number of steps along the diagonal of the box.
        shift: (R,) fraction of the first step that is before the box; None for 0.
        capacities: capacity for runs of 8 steps that are examined more closely (not in all forms), and number of slots.
    """
    tensors = rays.origins, rays.directions, rays.nears, rays.fars, occupancy.box
    return FILL(tensors, rays, occupancy, step, num_steps, shift, capacities)


def fill_reference(
    rays: Rays, occupancy: Occupancy, step: float, num_steps: int, shift: Tensor | None, capacities: tuple[int, int]
) -> Filled:
    """Compute `fill` of `rays`, `occupancy`, `step`, `num_steps`, `shift` and `capacities` in PyTorch."""
    count, device, (runs_capacity, capacity) = len(rays), rays.origins.device, capacities
    enter, leave, first, steps = step_range(rays, occupancy, step, 0.0, shift)
    slices = occupancy.slices_of(rays.times)
    # All possible runs of all rays: one look-up each, then one position each for the runs that count.
    most = math.ceil(most_steps(num_steps) / RUN)
    owners = torch.arange(count, device=device).repeat_interleave(most)
    run = torch.arange(most, device=device).repeat(count)
    middle = first.index_select(0, owners) + (run * RUN + RUN / 2) * step
    cells = occupancy.cells(rays.points(owners, middle), _of_rays(slices, owners))
    near = occupancy.near(math.ceil((RUN - 1) / 2 * step / occupancy.edge)).index_select(0, cells)
    near = near & (run * RUN < steps.index_select(0, owners))
    ends_of_runs = near.view(count, most).sum(1).cumsum(0)
    whole = ends_of_runs <= runs_capacity
    chosen = _places(near, runs_capacity)
    here = torch.arange(runs_capacity, device=device) < ends_of_runs[-1]
    here = (here & whole.index_select(0, owners.index_select(0, chosen))).repeat_interleave(RUN)
    owners = owners.index_select(0, chosen).repeat_interleave(RUN)
    k = (run.index_select(0, chosen)[:, None] * RUN + torch.arange(RUN, device=device)).view(-1)
    starts, ends = (first.index_select(0, owners) + (k + after) * step for after in (0, 1))
    middle = (starts + ends) / 2
    cells = occupancy.cells(rays.points(owners, middle), _of_rays(slices, owners))
    inside = (middle >= enter.index_select(0, owners)) & (middle < leave.index_select(0, owners))
    here = here & inside & occupancy.occupied.index_select(0, cells)
    starts, ends = (torch.where(here, values, 0) for values in (starts, ends))
    counts = steps.new_zeros(count).index_add_(0, owners, here.long())
    slots, kept = share_out(counts, capacity), _places(here, capacity)
    placed = Placed.of(starts.index_select(0, kept), ends.index_select(0, kept), counts.cumsum(0) - counts, slots)
    return Filled(placed, ends_of_runs[-1], counts.sum(), slots.left_out + (~whole).sum())


def _places(mask: Tensor, capacity: int) -> Tensor:
    """Return the first `capacity` positions (C,) int64 where `mask` (N,) is True; 0 for missing ones."""
    ranks = torch.where(mask, mask.cumsum(0) - 1, capacity).clamp(max=capacity)  # the others go past the end
    places = ranks.new_zeros(capacity + 1).scatter_(0, ranks, torch.arange(len(mask), device=mask.device))
    return places[:capacity]


@torch.no_grad()
def reach(placed: Placed, sigma: Tensor, early_stop: float, num_steps: int) -> Tensor:
    """Return the number (R,) int64 of intervals that the light of each ray reaches.

    Args:
        placed: intervals in C slots.
        sigma: (C,) density of each, 1/length.
        early_stop: transmittance below which a ray ends; 0 for never.
        num_steps: number of steps along the diagonal of the box, as in `fill`.
    """
    budget = -math.log(early_stop) if early_stop > 0 else math.inf
    sigma = sigma.detach().to(placed.t_starts.dtype)
    return REACH((sigma, placed.t_starts, placed.t_ends), placed, sigma, budget, num_steps)


def reach_reference(placed: Placed, sigma: Tensor, budget: float, num_steps: int) -> Tensor:
    """Compute `reach` in PyTorch, on any device.

    `placed`, `sigma` and `num_steps` are as in `reach`; `budget` is the optical depth where a ray ends.
    """
    slots = placed.slots
    tau = optical_depth(sigma, placed.t_ends - placed.t_starts).nan_to_num(nan=0.0)  # a NaN sample hides nothing
    longest = longest_ray(slots, num_steps)
    before = bounded_sum(tau, slots.owners, slots.ranks, len(slots.counts), longest)
    reached = (slots.ranks < slots.counts.index_select(0, slots.owners)) & (before < budget)
    return torch.zeros_like(slots.counts).index_add_(0, slots.owners, reached.long())


def longest_ray(slots: Slots, num_steps: int) -> int:
    """Return an upper bound of the number of slots of a ray, for `slots` of `fill` with `num_steps`."""
    return most_steps(num_steps) + len(slots.owners) // len(slots.counts) + 1


FILL = Operation("fill_march", fill_reference)
FILL.implementation(TRITON)(later("march.fixed_slots_triton", "fill"))
REACH = Operation("reach", reach_reference)
REACH.implementation(TRITON)(later("march.fixed_slots_triton", "reach"))

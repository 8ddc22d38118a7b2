"""Marching into a fixed number of slots, in Triton. `nerfloom.kernels.march.fixed_slots` has the definition.

Rays are marched twice, first to count their samples and then to write them at the counted positions; each thread
processes a ray. The host waits for nothing.
"""

# Triton gives the kernels' arguments their types.
# mypy: allow-untyped-defs, allow-untyped-decorators, allow-incomplete-defs

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from nerfloom.geometry.rays import Rays
from nerfloom.kernels.march.fixed_slots import Filled, Placed, most_steps, share_out
from nerfloom.kernels.march.occupancy import Occupancy
from nerfloom.kernels.march.waves_triton import SAMPLES, TritonMarch
from nerfloom.kernels.triton_launch import blocks, launch, optical_depth, own_rows


def fill(
    rays: Rays, occupancy: Occupancy, step: float, num_steps: int, shift: Tensor | None, capacities: tuple[int, int]
) -> Filled:
    """Compute `march.fixed_slots.fill` of `rays`, `occupancy`, `step`, `num_steps`, `shift` and `capacities`."""
    marched, capacity = TritonMarch(rays, occupancy, step, 0.0, shift, 0.0), capacities[1]
    found, limit = torch.empty_like(marched.next), most_steps(num_steps)
    marched.go_on(limit, found)
    counts = found.long()
    slots = share_out(counts, capacity)
    firsts = slots.counts.cumsum(0) - slots.counts
    starts, ends = (marched.spent.new_zeros(capacity) for _ in range(2))  # unwritten slots are read too
    marched.next.zero_()
    marched.go_on(limit, found, starts, ends, firsts, slots.counts)
    placed = Placed.of(starts, ends, firsts, slots)
    return Filled(placed, torch.zeros_like(slots.left_out), counts.sum(), slots.left_out)


@triton.jit(do_not_specialize=["rays"])
def _reach(sigma, starts, ends, offsets, counts, reached, budget, rays, BLOCK: tl.constexpr):
    r, here = own_rows(rays, BLOCK)
    first, count = tl.load(offsets + r, mask=here, other=0), tl.load(counts + r, mask=here, other=0)
    depth, found = tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK], tl.int64)
    going = (count > 0) & (depth < budget)
    while tl.max(going.to(tl.int32), 0) > 0:
        n = first + found
        length = tl.load(ends + n, mask=going, other=0.0) - tl.load(starts + n, mask=going, other=0.0)
        tau = optical_depth(tl.load(sigma + n, mask=going, other=0.0), length)
        depth += tl.where(tau == tau, tau, 0.0)  # NaN hides nothing
        found += going.to(tl.int64)
        going = going & (found < count) & (depth < budget)
    tl.store(reached + r, found, mask=here)


def reach(placed: Placed, sigma: Tensor, budget: float, num_steps: int) -> Tensor:
    """Compute `nerfloom.kernels.march.fixed_slots.reach_reference` of `placed`, `sigma`, `budget` and `num_steps`."""
    slots = placed.slots
    rays, reached = len(slots.counts), torch.empty_like(slots.counts)
    launch(
        _reach, (blocks(rays, SAMPLES),), sigma.contiguous(), placed.t_starts, placed.t_ends, slots.offsets,
        slots.counts, reached, float(budget), rays, BLOCK=SAMPLES,
    )  # fmt: skip
    return reached

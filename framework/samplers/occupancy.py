"""Skip empty space with an occupancy grid, and what is hidden by marching in waves.

The grid is Instant-NGP's (Mueller et al. 2022, appendix E.2): a moving maximum of the density in each cell, a cell
being skipped while a step through it would be nearly transparent. Waves: a few samples of every ray are evaluated
at a time, front to back, and only rays whose transmittance is not spent go on. What a wave evaluated is kept, so
nothing is evaluated twice and hidden samples never are.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from framework.bounds import intersect_box
from framework.fields.base import DensityFunction
from framework.kernels.compositing import optical_depth
from framework.rays import Rays, Samples

COARSE = 8
"""Steps that are tested together against the dilated grid before each is tested by itself."""
CHUNK = 2**15
"""Cells evaluated at once."""
WARM_UP_STEPS = 256
SHUFFLE_STRIDE = 2654435761
"""A prime, so that its multiples visit every cell once a pass, far from one another."""
WAVES = (8, 16, 32, 64, 128)
"""Samples a ray in each wave; the last size repeats."""


class OccupancySampler(nn.Module):
    """March through the occupied cells of a box.

    Args:
        box: (2, 3) corners of the space that is marched.
        resolution: cells along each axis.
        num_steps: steps along the box's diagonal.
        early_stop: transmittance below which the rest of a ray is dropped: the most that any colour channel can be
            off by. 0 keeps everything.
        alpha_threshold: a cell is occupied where one step through it has at least this opacity, or the grid's mean
            if that is less.
        moving: the scene changes with time: a cell is occupied if it is at any time.
    """

    box: Tensor
    density_grid: Tensor
    occupied: Tensor
    reachable: Tensor

    def __init__(
        self,
        box: Tensor,
        resolution: int = 128,
        num_steps: int = 512,
        early_stop: float = 1e-4,
        alpha_threshold: float = 0.01,
        moving: bool = False,
    ) -> None:
        super().__init__()
        self.resolution = resolution
        self.step_size = (box[1] - box[0]).norm().item() / num_steps
        self.num_steps = num_steps
        self.early_stop = early_stop
        self.alpha_threshold = alpha_threshold
        self.moving = moving
        self.register_buffer("box", box.clone())
        self.register_buffer("density_grid", torch.full((resolution**3,), torch.inf))
        self.register_buffer("occupied", torch.ones(resolution**3, dtype=torch.bool))
        self.register_buffer("reachable", torch.ones(resolution**3, dtype=torch.bool), persistent=False)
        self.register_load_state_dict_post_hook(lambda module, _: module._find_reachable())

    @property
    def occupied_share(self) -> float:
        """Share of cells that are not skipped."""
        return self.occupied.float().mean().item()

    # -- sampling ---------------------------------------------------------------------------------------------

    def sample(self, rays: Rays, density: DensityFunction, jitter: bool) -> Samples:
        """Samples in occupied cells, as far as light gets; densities and features attached."""
        return evaluate_in_waves(rays, self.march(rays, jitter), density, self.early_stop)

    @torch.no_grad()
    def march(self, rays: Rays, jitter: bool) -> Samples:
        """All steps of R rays whose middle lies in an occupied cell."""
        enter, leave = intersect_box(rays.origins, rays.directions, self.box)
        enter, leave = torch.maximum(enter, rays.nears), torch.minimum(leave, rays.fars)
        first = enter - torch.rand_like(enter) * self.step_size if jitter else enter
        counts = ((leave - first) / self.step_size).ceil().clamp(min=0, max=self.num_steps + 2)
        counts = torch.where(leave > enter, counts, torch.zeros_like(counts)).long()

        # Coarse: the middle of each run of COARSE steps against the dilated grid.
        run_rays, run = _ranges((counts + COARSE - 1) // COARSE)
        middle = first[run_rays] + (run * COARSE + COARSE / 2) * self.step_size
        keep = self.reachable[self.cells(rays.points(run_rays, middle))]
        run_rays, run = run_rays[keep], run[keep]

        # Fine: each step of the runs that are left.
        steps = run[:, None] * COARSE + torch.arange(COARSE, device=run.device)
        ray_indices = run_rays.repeat_interleave(COARSE)
        steps = steps.reshape(-1)
        starts = first[ray_indices] + steps * self.step_size
        middle = starts + self.step_size / 2
        cells = self.cells(rays.points(ray_indices, middle))
        keep = self.occupied[cells] & (middle >= enter[ray_indices]) & (middle < leave[ray_indices])
        ray_indices, starts = ray_indices[keep], starts[keep]
        per_ray = torch.bincount(ray_indices, minlength=len(rays))
        offsets = functional.pad(per_ray.cumsum(0), (1, 0))
        return Samples(starts, starts + self.step_size, offsets)

    def cells(self, positions: Tensor) -> Tensor:
        """Index (N,) of the cell each position (N, 3) lies in; outside positions go to the nearest cell."""
        scale = self.resolution / (self.box[1] - self.box[0])
        x, y, z = ((positions - self.box[0]) * scale).long().clamp(0, self.resolution - 1).unbind(-1)
        return (x * self.resolution + y) * self.resolution + z

    # -- keeping the grid up ----------------------------------------------------------------------------------

    @torch.no_grad()
    def update(self, step: int, density: DensityFunction) -> None:
        """Evaluate some cells and mark anew which are occupied: every 8 steps at first, every 16 later.

        At first the cells come in the order of a fixed shuffle, so that each is seen soon; afterwards half of them
        are drawn among all cells, so that an emptied one can fill again, and half among the occupied ones.
        """
        warming_up = step < WARM_UP_STEPS
        if step == 0 or step % (8 if warming_up else 16):
            return
        cells = self._shuffled(step // 8 - 1) if warming_up else self._drawn()
        n = self.resolution
        corner = torch.stack([cells // n**2, cells // n % n, cells % n], dim=-1)
        unit = (corner + torch.rand(len(cells), 3, device=cells.device)) / n
        times = torch.rand(len(cells), device=cells.device) if self.moving else None
        positions = torch.lerp(self.box[0], self.box[1], unit)
        sigma = _in_chunks(density, positions, times)
        decayed = self.density_grid[cells] * (0.7 if warming_up else 0.95)
        seen = torch.isfinite(decayed)
        self.density_grid[cells] = torch.where(seen, torch.maximum(decayed, sigma), sigma)
        alpha = -torch.expm1(-self.density_grid * self.step_size)
        self.occupied.copy_(alpha >= min(self.alpha_threshold, alpha.mean().item()))
        self._find_reachable()

    def _shuffled(self, turn: int) -> Tensor:
        """The cells of one of the first updates: four passes over the grid by step WARM_UP_STEPS.

        Of cells already found empty, which stay so unless the field changes its mind, one in eight is looked at.
        """
        num_cells = self.resolution**3
        share = math.ceil(4 * num_cells * 8 / WARM_UP_STEPS)
        places = torch.arange(turn * share, (turn + 1) * share, device=self.occupied.device)
        cells = places * SHUFFLE_STRIDE % num_cells
        return cells[self.occupied[cells] | (torch.rand(share, device=cells.device) < 1 / 8)]

    def _drawn(self) -> Tensor:
        """Half anywhere, half among occupied cells. A cell drawn twice is evaluated twice, harmlessly."""
        num_cells = self.resolution**3
        half = max(num_cells // 64, 1)
        device = self.occupied.device
        occupied = self.occupied.nonzero().squeeze(-1)
        anywhere = torch.randint(num_cells, (half,), device=device)
        if len(occupied) == 0:
            return anywhere
        return torch.cat([anywhere, occupied[torch.randint(len(occupied), (half,), device=device)]])

    def _find_reachable(self) -> None:
        """Cells from which an occupied one lies within half a run of COARSE steps, along any axis."""
        cell = ((self.box[1] - self.box[0]) / self.resolution).min().item()
        radius = math.ceil((COARSE - 1) / 2 * self.step_size / cell)
        grid = self.occupied.view(self.resolution, self.resolution, self.resolution)
        for axis in range(3):
            grid = _dilated(grid, radius, axis)
        self.reachable.copy_(grid.reshape(-1))


def _dilated(grid: Tensor, radius: int, axis: int) -> Tensor:
    """Cells with a true cell within `radius` along `axis`."""
    out, size = grid.clone(), grid.shape[axis]
    for shift in range(1, min(radius, size - 1) + 1):
        out.narrow(axis, 0, size - shift).logical_or_(grid.narrow(axis, shift, size - shift))
        out.narrow(axis, shift, size - shift).logical_or_(grid.narrow(axis, 0, size - shift))
    return out


def _in_chunks(density: DensityFunction, positions: Tensor, times: Tensor | None) -> Tensor:
    """Density (N,) at positions (N, 3), a chunk at a time: fresh memory of many megabytes costs more than the work."""
    parts = positions.split(CHUNK)
    when = [None] * len(parts) if times is None else times.split(CHUNK)
    return torch.cat([density(part, t)[0] for part, t in zip(parts, when, strict=True)])


def evaluate_in_waves(rays: Rays, samples: Samples, density: DensityFunction, early_stop: float) -> Samples:
    """Evaluate `samples` front to back, a wave at a time, and drop what lies behind a spent transmittance.

    Args:
        rays: R rays.
        samples: candidates on them.
        density: the field's density.
        early_stop: transmittance under which a ray ends.
    Returns: the samples that were evaluated, with density and features attached, gradients included. What was
        dropped could have changed a colour channel by at most `early_stop`.
    """
    budget = -math.log(early_stop) if early_stop > 0 else math.inf
    counts, firsts = samples.counts, samples.offsets[:-1]
    spent = torch.zeros(len(rays), device=firsts.device)
    alive = counts.nonzero().squeeze(-1)
    parts: list[tuple[Tensor, Tensor, Tensor]] = []
    start, wave = 0, 0
    while len(alive) or not parts:
        size = WAVES[min(wave, len(WAVES) - 1)]
        owners, within = _ranges((counts[alive] - start).clamp(max=size))
        owners = alive[owners]
        chosen = firsts[owners] + start + within
        t = (samples.t_starts[chosen] + samples.t_ends[chosen]) / 2
        sigma, features = density(rays.points(owners, t), None if rays.times is None else rays.times[owners])
        parts.append((chosen, sigma, features))
        with torch.no_grad():
            spent.index_add_(0, owners, optical_depth(sigma.float(), samples.deltas[chosen]))
        start, wave = start + size, wave + 1
        alive = alive[(counts[alive] > start) & (spent[alive] < budget)]
    chosen = torch.cat([part[0] for part in parts])
    order = chosen.argsort()
    chosen = chosen[order]
    per_ray = torch.bincount(samples.ray_indices[chosen], minlength=len(rays))
    return Samples(
        samples.t_starts[chosen],
        samples.t_ends[chosen],
        functional.pad(per_ray.cumsum(0), (1, 0)),
        sigma=torch.cat([part[1] for part in parts])[order],
        features=torch.cat([part[2] for part in parts])[order],
    )


def _ranges(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Owner (N,) and rank (N,) of each item when owner i has counts[i] of them: 0 .. counts[i] - 1."""
    owners = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)
    firsts = counts.cumsum(0) - counts
    return owners, torch.arange(len(owners), device=counts.device) - firsts[owners]

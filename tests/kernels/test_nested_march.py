"""Marching through nested boxes: every form against brute force in float64, which looks at each step by itself."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from nerfloom.geometry.bounds import intersect_box, nested_boxes
from nerfloom.geometry.rays import Rays
from nerfloom.kernels import native
from nerfloom.kernels.march.occupancy import Occupancy, own_cells
from nerfloom.kernels.march.waves import CompiledMarch, March, ReferenceMarch

BOX = torch.tensor([[-1.0, -1.5, -0.5], [1.0, 0.5, 1.5]])
LEVELS, RESOLUTION = 5, 16
STEP, CONE = 0.02, 1 / 64
NEAR = 2e-3
"""Cells; so near to a face rounding decides."""
FORMS = [CompiledMarch, ReferenceMarch]


def of(form: type[March], *arguments: object) -> March:
    if form is CompiledMarch and not native.available():
        pytest.skip("the compiled kernels are not installed")
    return form(*arguments)  # type: ignore[arg-type]


def grid(share: float, seed: int = 0, levels: int = LEVELS) -> Occupancy:
    generator = torch.Generator().manual_seed(seed)
    occupied = torch.rand(levels * RESOLUTION**3, generator=generator) < share
    return Occupancy(occupied & own_cells(levels, RESOLUTION), BOX, RESOLUTION, levels)


def rays_of(kind: str, count: int = 40) -> Rays:
    """Rays that start in the smallest box, in a larger one, outside all, or are parallel to the axes."""
    random = np.random.default_rng(3)
    center, half = np.array([0.0, -0.5, 0.5]), 1.0
    directions = random.normal(size=(count, 3))
    radius = {"inside": 0.9, "between": 11.0, "outside": 40.0, "parallel": 9.0}[kind]
    origins = center + half * radius * random.uniform(-1, 1, (count, 3))
    if kind == "outside":
        origins = center + 40.0 * directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    if kind in ("between", "outside"):
        directions = center + random.uniform(-3, 3, (count, 3)) - origins
    if kind == "parallel":
        directions = np.eye(3)[np.arange(count) % 3] * random.choice([-1, 1], (count, 1))
        origins[: count // 2] = np.where(directions[: count // 2] != 0, origins[: count // 2], 0.3)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    nears, fars = torch.full((count,), 0.05), torch.full((count,), 1000.0)
    return Rays(torch.from_numpy(origins).float(), torch.from_numpy(directions).float(), nears, fars)


def steps_by_brute_force(rays: Rays, cells: Occupancy, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Ends (N, 2) of the steps of a ray with their middle in an occupied cell, and whether this is certain (N,)."""
    half, levels = 2.0 ** (cells.levels - 1), cells.levels
    center = np.array([0.0, -0.5, 0.5])
    origin, direction = (part[index].double().numpy() for part in (rays.origins, rays.directions))
    moving = direction != 0
    faces = (center + half * np.array([[-1.0], [1.0]]) - origin)[:, moving] / direction[moving]
    enter, leave = faces.min(0).max(), faces.max(0).min()
    if np.any(~moving & (np.abs(origin - center) > half)) or leave <= max(enter, 0.05):
        return np.zeros((0, 2)), np.zeros(0, bool)
    t, found, sure = max(enter, 0.05), [], []
    while t < leave:
        end = t + STEP if t < STEP / CONE else t * (1 + CONE)
        middle = (t + end) / 2
        across = origin + middle * direction - center
        far = np.abs(across).max()
        level = max(0, math.floor(math.log2(far)) + 1) if far > 0 else 0
        place = (across / 2.0**level + 1) / 2 * RESOLUTION
        x, y, z = np.clip(np.floor(place).astype(int), 0, RESOLUTION - 1)
        cell = ((min(level, levels - 1) * RESOLUTION + x) * RESOLUTION + y) * RESOLUTION + z
        if middle < leave and bool(cells.occupied[cell]):
            found.append((t, end))
            sure.append(bool(np.all(np.abs(place - np.round(place)) > NEAR)) and middle < leave - 1e-3)
        t = end
    return np.array(found).reshape(-1, 2), np.array(sure, bool)


def marched(march: March, limit: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """Ends (N, 2) and rays (N,) of all samples."""
    while (wave := march.wave(limit)) is not None:
        march.advance(torch.zeros_like(wave.t_starts))
    if not march.waves:
        return np.zeros((0, 2)), np.zeros(0, int)
    starts, ends, owners = (torch.cat([getattr(w, n) for w in march.waves]) for n in ("t_starts", "t_ends", "owners"))
    return torch.stack([starts, ends], -1).double().numpy(), owners.numpy()


@pytest.mark.parametrize("kind", ["inside", "between", "outside", "parallel"])
@pytest.mark.parametrize("share", [0.003, 0.2])
@pytest.mark.parametrize("form", FORMS)
def test_the_steps_are_those_of_brute_force(form: type[March], share: float, kind: str) -> None:
    rays, cells = rays_of(kind), grid(share)
    ends, owners = marched(of(form, rays, cells, STEP, CONE, None, 0.0))
    expected = total = 0
    for index in range(len(rays)):
        truth, sure = steps_by_brute_force(rays, cells, index)
        mine = ends[owners == index]
        apart = np.abs(truth[:, None] - mine).max(-1)
        close = 1e-4 * np.maximum(truth[:, 1], 1)
        missed = (apart.min(1, initial=9.0) > close) & sure
        extra = (close < apart.T).all(1) if len(truth) else np.ones(len(mine), bool)
        assert not missed.any(), (index, truth[missed])
        expected, total = expected + int(sure.sum()), total + int(extra.sum())
    assert expected > (3 if share < 0.01 else 300)
    assert total <= 0.02 * len(ends) + 2  # steps on faces alone


@pytest.mark.parametrize("form", FORMS)
def test_a_full_grid_has_no_gaps_where_the_box_changes(form: type[March]) -> None:
    """Each step begins where the last one ends, from the ray's start to the end of the largest box."""
    rays, cells = rays_of("inside"), grid(2.0)
    ends, owners = marched(of(form, rays, cells, STEP, CONE, None, 0.0))
    leave = intersect_box(rays.origins, rays.directions, cells.outer)[1].double().numpy()
    for index in range(len(rays)):
        mine = ends[owners == index]
        np.testing.assert_allclose(mine[1:, 0], mine[:-1, 1], rtol=1e-5)
        assert abs(mine[0, 0] - 0.05) < 1e-6
        assert abs(mine[-1, 1] / leave[index] - 1) <= CONE
        lengths = np.diff(mine, axis=-1)[:, 0]
        np.testing.assert_allclose(lengths, np.maximum(STEP, CONE * mine[:, 0]), rtol=2e-2)


@pytest.mark.parametrize("form", FORMS)
def test_one_far_cell_is_found_across_empty_boxes(form: type[March]) -> None:
    """Rays from the middle towards one cell of the largest box, when all others are empty."""
    cells = grid(0.0)
    number = ((4 * RESOLUTION + 14) * RESOLUTION + 2) * RESOLUTION + 7
    cells.occupied[number] = True
    low, high = nested_boxes(BOX, LEVELS)[-1]
    targets = low + (torch.tensor([14.0, 2, 7]) + 0.1 + 0.8 * torch.rand(50, 3)) / RESOLUTION * (high - low)
    origins = torch.tensor([0.0, -0.5, 0.5]) + torch.rand(50, 3) - 0.5
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    ends, owners = marched(of(form, Rays(origins, directions), cells, STEP, CONE, None, 0.0))
    assert len(np.unique(owners)) >= 48  # a step may pass over a corner
    middles = torch.from_numpy(ends.mean(-1)).float()
    places = Rays(origins, directions).points(torch.from_numpy(owners), middles)
    at = (places - low) / (high - low) * RESOLUTION
    inside = (at > torch.tensor([14.0, 2, 7]) - NEAR) & (at < torch.tensor([15.0, 3, 8]) + NEAR)
    assert bool(inside.all())


def test_cells_of_positions_are_those_of_the_smallest_box() -> None:
    boxes, cells = nested_boxes(BOX, LEVELS).double(), grid(0.5)
    positions = (torch.randn(2000, 3) * 10.0 ** torch.empty(2000, 1).uniform_(-1, 1.1)).double()
    index = replace(cells, box=BOX.double()).cells(positions)
    for place, number in zip(positions, index.tolist(), strict=True):
        level = next((k for k, (low, high) in enumerate(boxes) if bool(((place > low) & (place < high)).all())), None)
        if level is None:
            assert number // RESOLUTION**3 == LEVELS - 1
            continue
        x, y, z = ((place - boxes[level, 0]) / (boxes[level, 1] - boxes[level, 0]) * RESOLUTION).long().tolist()
        assert number == ((level * RESOLUTION + x) * RESOLUTION + y) * RESOLUTION + z


def test_the_middle_of_a_box_says_what_the_smaller_one_holds() -> None:
    cells = grid(0.01)
    filled, quarter = cells.filled, RESOLUTION // 4
    for level in range(1, LEVELS):
        middle = filled[level, quarter:-quarter, quarter:-quarter, quarter:-quarter]
        blocks = filled[level - 1].view(*[RESOLUTION // 2, 2] * 3).permute(0, 2, 4, 1, 3, 5).flatten(3)
        assert torch.equal(middle, blocks.any(-1))
        own = own_cells(LEVELS, RESOLUTION).view_as(filled)[level]
        assert torch.equal(filled[level][own], cells.occupied.view_as(filled)[level][own])


@pytest.mark.parametrize("form", FORMS)
def test_one_box_is_marched_as_ever(form: type[March]) -> None:
    """If the larger boxes are empty, the samples are the smallest box's alone."""
    single, rays = grid(0.3, levels=1), rays_of("between")
    nested = Occupancy(torch.cat([single.occupied, torch.zeros(4 * RESOLUTION**3, dtype=torch.bool)]), BOX, 16, 5)
    starts = torch.zeros(len(rays))
    inside = replace(rays, origins=torch.tensor([0.0, -0.5, 0.5]) + 0.1 * rays.directions, nears=starts)
    found = [marched(of(form, inside, cells, STEP, CONE, None, 0.0)) for cells in (single, nested)]
    order = [np.lexsort((ends[:, 0], owners)) for ends, owners in found]
    np.testing.assert_allclose(found[0][0][order[0]], found[1][0][order[1]], rtol=1e-6)
    np.testing.assert_array_equal(found[0][1][order[0]], found[1][1][order[1]])


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("share", [0.0, 0.3])
def test_the_rest_is_one_sample_behind_the_grid(form: type[March], share: float) -> None:
    """Rays with light left get one where they leave the largest box, evaluated half way to their far ends."""
    rays, cells = rays_of("inside"), grid(share)
    march = of(form, rays, cells, STEP, CONE, None, 1e-2)
    opaque = torch.arange(len(rays)) % 2 == 0
    while (wave := march.wave(march.next_limit)) is not None:
        march.advance(torch.where(opaque[wave.owners], 1e5, 0.0))
    met = torch.zeros(len(rays), dtype=torch.bool)
    for wave in march.waves:
        met[wave.owners] = True
    rest = march.rest(cells.outer)
    assert rest is not None
    assert rest.owners.tolist() == (~(opaque & met)).nonzero().squeeze(-1).tolist()
    leave = intersect_box(rays.origins, rays.directions, cells.outer)[1][rest.owners]
    torch.testing.assert_close(rest.t_starts, leave)
    torch.testing.assert_close(rest.t_ends, torch.full_like(leave, 1000.0))
    order, offsets = march.finish()
    owners = torch.cat([wave.owners for wave in march.waves])[order]
    assert torch.equal(owners, torch.repeat_interleave(torch.arange(len(rays)), offsets.diff()))
    ends = torch.cat([wave.t_ends for wave in march.waves])[order]
    torch.testing.assert_close(ends[offsets[1:][rest.owners] - 1], rest.t_ends)
    assert march.longest is None or march.longest >= int(offsets.diff().max())
    missing = Rays(torch.full((1, 3), 90.0), torch.eye(3)[:1], torch.tensor([0.5]))
    away = of(form, missing, cells, STEP, CONE, None, 1e-2)
    assert away.wave(8) is None
    last = away.rest(cells.outer)
    assert last is not None
    assert (float(last.t_starts), float(last.t_ends)) == (0.5, 1.5)

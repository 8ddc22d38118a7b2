"""Marching through grids that are nearly empty: each form finds every step with its middle in an occupied cell.

The truth is brute force in float64. Distances to occupied cells are long there, so a map of distances with an error
along one axis lets rays pass over cells that they should meet.
"""

from itertools import product

import numpy as np
import pytest
import torch

from nerfloom.geometry.rays import Rays
from nerfloom.kernels import native
from nerfloom.kernels.march.occupancy import Occupancy
from nerfloom.kernels.march.waves import CompiledMarch, ReferenceMarch

BOX = np.array([[-1.0, -1.2, -0.9], [1.1, 1.0, 1.3]])
RESOLUTION, STEP = 48, 0.013
COUNT = 400
NEAR = 2e-3
"""Cells; so near to a face rounding decides."""


def occupied(kind: str) -> np.ndarray:
    """(n, n, n) bool: a cell far from all others, a rod along an axis, or a plate across it."""
    cells = np.zeros((RESOLUTION,) * 3, bool)
    axis = "xyz".find(kind[-1])
    if kind.startswith("rod"):
        cells[tuple(slice(None) if a == axis else 21 + 3 * a for a in range(3))] = True
    elif kind.startswith("plate"):
        cells[tuple(37 if a == axis else slice(None) for a in range(3))] = True
    else:
        cells[5, 40, 22] = cells[41, 3, 30] = True
    return cells


def rays_towards(cells: np.ndarray) -> Rays:
    """Rays from all around, each through a point of an occupied cell."""
    random = np.random.default_rng(0)
    chosen = np.argwhere(cells)[random.integers(0, cells.sum(), COUNT)]
    targets = BOX[0] + (chosen + random.random((COUNT, 3))) / RESOLUTION * (BOX[1] - BOX[0])
    directions = random.normal(size=(COUNT, 3))
    directions[: COUNT // 4] = np.eye(3)[np.arange(COUNT // 4) % 3] + 0.01  # nearly along the axes
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    origins, unit = (torch.from_numpy(values).float() for values in (targets - 3 * directions, directions))
    return Rays(origins, unit, torch.full((COUNT,), 0.1), torch.full((COUNT,), 10.0))


def places(rays: Rays, owners: np.ndarray, distances: np.ndarray) -> np.ndarray:
    """(N, 3) where rays are at distances (N,), in cells."""
    origins, directions = rays.origins.double().numpy()[owners], rays.directions.double().numpy()[owners]
    return (origins + distances[:, None] * directions - BOX[0]) / (BOX[1] - BOX[0]) * RESOLUTION


def held(cells: np.ndarray, at: np.ndarray) -> np.ndarray:
    """(N,) bool: whether places (N, 3) lie in an occupied cell."""
    return cells[tuple(np.clip(np.floor(at).astype(int), 0, RESOLUTION - 1).T)]


def middles_by_brute_force(rays: Rays, cells: np.ndarray) -> list[np.ndarray]:
    """For each ray the distances of the steps' middles that lie in an occupied cell, and not on its faces."""
    origins, directions = rays.origins.double().numpy(), rays.directions.double().numpy()
    ends = (BOX[:, None] - origins) / directions
    enter, leave = ends.min(0).max(-1), ends.max(0).min(-1)
    found = []
    for index in range(COUNT):
        middles = enter[index] + (np.arange(int((leave[index] - enter[index]) / STEP) + 2) + 0.5) * STEP
        middles = middles[middles < leave[index] - 1e-4]
        at = places(rays, np.full(len(middles), index), middles)
        clear = (np.abs(at - np.round(at)) > NEAR).all(-1)
        found.append(middles[held(cells, at) & clear])
    return found


@pytest.mark.parametrize("kind", ["cells", "rod x", "rod y", "rod z", "plate x", "plate y", "plate z"])
@pytest.mark.parametrize("form", [CompiledMarch, ReferenceMarch])
def test_nothing_is_passed_over(form: type[CompiledMarch] | type[ReferenceMarch], kind: str) -> None:
    if form is CompiledMarch and not native.available():
        pytest.skip("the compiled kernels are not installed")
    cells = occupied(kind)
    rays = rays_towards(cells)
    grid = Occupancy(torch.from_numpy(cells.reshape(-1)), torch.from_numpy(BOX).float(), RESOLUTION)
    march = form(rays, grid, STEP, 0.0, None, 0.0)
    while (wave := march.wave(16)) is not None:
        march.advance(torch.zeros_like(wave.t_starts))
    expected = middles_by_brute_force(rays, cells)
    owners, starts, ends = (torch.cat([getattr(w, n) for w in march.waves]) for n in ("owners", "t_starts", "t_ends"))
    middles, owned = ((starts + ends) / 2).double().numpy(), owners.numpy()
    assert sum(len(part) for part in expected) > 200
    missed = sum(
        int((np.abs(part[:, None] - middles[owned == index]).min(-1, initial=9.0) > 1e-4).sum())
        for index, part in enumerate(expected)
    )
    at = places(rays, owned, middles)
    nearly = [held(cells, at + NEAR * np.array(corner)) for corner in product((-1, 1), repeat=3)]
    assert missed == 0
    assert np.any(nearly, axis=0).all()

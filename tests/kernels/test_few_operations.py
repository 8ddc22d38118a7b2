"""Torch's forms in few operations, for GPUs: values and gradients equal the readable references' in float64."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from nerfloom.cameras.rigid_motion import RIGID_MOTIONS
from nerfloom.kernels import native
from nerfloom.kernels.compositing.density import bounded_sum, segmented_sum
from nerfloom.kernels.dispatch import FEW_OPERATIONS, Operation
from nerfloom.kernels.encodings.spherical_harmonics import SPHERICAL_HARMONICS
from nerfloom.kernels.grids import hash_grid, planes
from nerfloom.kernels.grids.hash_grid import HASH_GRID
from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout
from nerfloom.kernels.grids.multisampled_grid import MULTISAMPLED_GRID
from nerfloom.kernels.grids.plane_bands import PLANE_BANDS
from nerfloom.kernels.grids.planes import PLANES
from nerfloom.kernels.grids.planes_layout import PlanesLayout
from nerfloom.kernels.march.waves import ReferenceMarch
from nerfloom.kernels.rows import gather_rows
from nerfloom.kernels.splats import blend
from nerfloom.kernels.splats.blend import BLEND, CHANNELS, blend_reference
from nerfloom.kernels.splats.project import PROJECT, Record, SplatCamera, project_reference
from nerfloom.kernels.splats.tiles import TILES, TileLists, tile_lists_reference
from nerfloom.kernels.surfaces.distance import DISTANCE_NETWORK
from tests.kernels.test_march import occupancy, random_rays

GRID = HashGridLayout.build(num_levels=4, base_resolution=4, max_resolution=40, log2_table_size=9)
VM = PlanesLayout.build(((5, 6, 7),) * 3, (((0, 1), (2,)), ((0, 2), (1,)), ((1, 2), (0,))))
CP = PlanesLayout.build(((5, 6, 7),), (((0,), (1,), (2,)),))
MOVING = PlanesLayout.build(((5, 6, 7, 3), (8, 9, 10, 3)))
EDGES = torch.tensor([[0.0, 0, 0], [1, 1, 1], [1, 0, 0.5], [-1, 2, 0.3], [0.5, 0.25, 1]], dtype=torch.float64)


def few(operation: Operation[..., Any]) -> Callable[..., Any]:
    return next(each.run for each in operation.implementations if each.backend is FEW_OPERATIONS)


def derived(function: Callable[..., Tensor], *inputs: Tensor) -> list[Tensor]:
    """Value, gradients, and gradients of their squares, by each input."""
    leaves = [values.clone().requires_grad_() for values in inputs]
    out = function(*leaves)
    direction = torch.randn(out.shape, dtype=out.dtype, generator=torch.Generator().manual_seed(7))
    slopes = torch.autograd.grad((out * direction).sum(), leaves, create_graph=True)
    squares = torch.stack([slope.square().sum() for slope in slopes]).sum()
    if not squares.requires_grad:  # of a linear function
        return [out, *slopes]
    return [out, *slopes, *torch.autograd.grad(squares, leaves, allow_unused=True, materialize_grads=True)]


def same(found: list[Tensor], truth: list[Tensor]) -> None:
    for value, true in zip(found, truth, strict=True):
        torch.testing.assert_close(value, true, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("held", [2**26, 1000])
def test_a_hash_grid(held: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """All positions at once, and in parts."""
    monkeypatch.setattr(hash_grid, "MAX_HELD", held)
    torch.manual_seed(0)
    positions = torch.cat([torch.rand(60, 3, dtype=torch.float64), EDGES])
    table = torch.randn(GRID.num_entries, 2, dtype=torch.float64)
    forms = few(HASH_GRID), HASH_GRID.reference.run
    same(*(derived(lambda x, t, run=run: run(x, t, GRID, None), positions, table) for run in forms))
    assert few(HASH_GRID)(positions[:0], table, GRID, None).shape == (0, 8)


def test_a_distance(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its gradient too, and the gradients of both, also without the compiled grid."""
    torch.manual_seed(0)
    positions = torch.cat([torch.rand(60, 3, dtype=torch.float64), EDGES])
    shapes = (GRID.num_entries, 2), (6, 8), (3, 6)
    given = positions, *(torch.randn(shape, dtype=torch.float64) for shape in shapes)
    truth = derived(lambda *of: DISTANCE_NETWORK.reference.run(*of, GRID, None), *given)
    for available in (True, False):
        monkeypatch.setattr(native, "available", lambda available=available: available)
        same(derived(lambda *of: few(DISTANCE_NETWORK)(*of, GRID, None), *given), truth)
    with torch.no_grad():
        assert torch.equal(few(DISTANCE_NETWORK)(*given, GRID, None).isnan(), truth[0].isnan())


@pytest.mark.parametrize("count", [1, 6])
def test_a_multisampled_grid(count: int) -> None:
    torch.manual_seed(0)
    points = torch.rand(120, count, 4, dtype=torch.float64)
    points[60:, :, 3] /= 100
    table = torch.randn(GRID.num_entries, 2, dtype=torch.float64)
    forms = few(MULTISAMPLED_GRID), MULTISAMPLED_GRID.reference.run
    same(*(derived(lambda x, t, run=run: run(x, t, GRID, None), points, table) for run in forms))
    assert few(MULTISAMPLED_GRID)(points[:0], table, GRID, None).shape == (0, 8)


def test_a_hash_grid_shows_nan() -> None:
    table, positions = torch.randn(GRID.num_entries, 2), torch.rand(3, 3)
    positions[1, 0] = torch.nan
    found = few(HASH_GRID)(positions, table, GRID, None)
    assert found.isnan().any(-1).tolist() == [False, True, False]


@pytest.mark.parametrize("layout", [VM, CP, MOVING])
@pytest.mark.parametrize("held", [2**26, 500])
def test_planes(layout: PlanesLayout, held: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planes, "MAX_HELD", held)
    torch.manual_seed(0)
    edges = torch.cat([EDGES, EDGES[:, :1]], dim=-1)
    positions = torch.cat([torch.rand(40, 4, dtype=torch.float64), edges])[:, : layout.dims]
    table = torch.randn(layout.num_entries, 5, dtype=torch.float64)
    forms = few(PLANES), PLANES.reference.run
    same(*(derived(lambda x, t, run=run: run(x, t, layout, None), positions, table) for run in forms))
    assert few(PLANES)(positions[:0], table, layout, None).shape == (0, 5 * layout.num_groups)


def test_bands_of_planes() -> None:
    table, spans = torch.randn(30, 4, dtype=torch.float64), ((3, 3, 2), (7, 1, 5), (20, 1, 1))
    found = []
    for run in (few(PLANE_BANDS), PLANE_BANDS.reference.run):
        leaf = table.clone().requires_grad_()
        first, middle, last = run(leaf, spans, None)  # the middle one has no gradient
        (first.square().sum() + last.sum()).backward()
        found.append([first, middle, last, leaf.grad])
    same(*found)


@pytest.mark.parametrize("levels", [2, 3, 4])
def test_harmonics(levels: int) -> None:
    directions = torch.randn(20, 3, dtype=torch.float64)  # of any length: it is the same polynomial
    forms = few(SPHERICAL_HARMONICS), SPHERICAL_HARMONICS.reference.run
    same(*(derived(lambda x, run=run: run(x, levels), directions) for run in forms))
    with torch.autocast("cpu", torch.bfloat16):
        rounded = few(SPHERICAL_HARMONICS)(directions.float(), levels)
    torch.testing.assert_close(rounded, forms[1](directions, levels).float(), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("memory", [2**26, 1])
def test_sums_on_rays_of_bounded_length(memory: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfloom.kernels.compositing.density.MAX_PADDED", memory)
    counts = torch.tensor([3, 0, 1, 7, 0, 5])
    owners = torch.arange(6).repeat_interleave(counts)
    places = torch.cat([torch.arange(count) for count in counts.tolist()])
    values = torch.rand(16, dtype=torch.float64)
    truth = torch.stack(
        [values[(owners == ray) & (places < place)].sum() for ray, place in zip(owners, places, strict=True)]
    )
    for longest in (7, 12):
        same([bounded_sum(values, owners, places, 6, longest)], [truth])
    same(
        derived(lambda x: bounded_sum(x, owners, places, 6, 7).square(), values),
        derived(lambda x: segmented_sum(x, places).square(), values),
    )
    values[5] = torch.nan  # in the fourth ray, where it stays
    hidden = bounded_sum(values, owners, places, 6, 7).isnan()
    assert torch.equal(hidden, (owners == 3) & (places > 1))


@pytest.mark.parametrize(("sigma", "early_stop"), [(0.0, 1e-3), (3.0, 1e-3), (3.0, 0.0), (1e4, 1e-2)])
def test_one_wave_finds_what_many_find(sigma: float, early_stop: float) -> None:
    rays, grid, found = random_rays(200), occupancy(8, 0.5), []
    for limit in (None, 8):
        march = ReferenceMarch(rays, grid, 0.05, 0.0, None, early_stop)
        while (wave := march.wave(limit or march.next_limit)) is not None:
            march.advance(sigma * (1 + wave.positions[:, 0].abs()))
        order, offsets = march.finish()
        assert limit is not None or len(march.waves) == 1
        columns = [[getattr(w, name) for w in march.waves] for name in ("t_starts", "t_ends", "owners", "positions")]
        found.append([*gather_rows(columns, order), offsets])
        assert march.longest is not None
        assert march.longest >= int(offsets.diff().max())
    for one, many in zip(*found, strict=True):
        assert torch.equal(one, many)


def splats() -> tuple[Tensor, SplatCamera]:
    torch.manual_seed(3)
    means = torch.cat([torch.rand(150, 3) - 0.5, torch.randn(50, 3)]).double() + torch.tensor([0.0, 0.0, 3.0])
    rows = torch.rand(200, 3) / 2 - 3, torch.randn(200, 4), torch.randn(200), torch.rand(200, 3), torch.zeros(200, 3, 0)
    camera = SplatCamera(torch.eye(3, 4), (60.0, 62.0, 35.0, 25.0), 70, 50)
    return project_reference(means, *(row.double() for row in rows), camera, 0)[0], camera


def test_lists_of_tiles() -> None:
    records, camera = splats()
    for given in (records, records[:0], records * 0):
        found, truth = (form(given, camera.width, camera.height) for form in (few(TILES), tile_lists_reference))
        assert all(torch.equal(one, other) for one, other in zip(found[:4], truth[:4], strict=True))
    assert len(tile_lists_reference(records, camera.width, camera.height).ids) > 400


@pytest.mark.parametrize("room", [0, 100, 400, 5000])
def test_lists_of_tiles_with_little_room(room: int) -> None:
    """The lists hold the nearest Gaussians; entries behind them are undefined, and not visible."""
    records, camera = splats()
    found = few(TILES)(records, camera.width, camera.height, True, room)
    truth = tile_lists_reference(records, camera.width, camera.height, True, room)
    entries = len(truth.ids)
    assert entries <= room == len(found.ids) == len(found.slots)
    assert torch.equal(found.offsets, truth.offsets)
    assert torch.equal(found.firsts, truth.firsts)
    assert torch.equal(found.ids[:entries], truth.ids)
    assert torch.equal(found.slots[:entries], truth.slots)
    assert found.needed == truth.needed == len(tile_lists_reference(records, camera.width, camera.height).ids)
    assert (entries == truth.needed) == (room == 5000)
    distances = records[:, Record.DISTANCE][records[:, Record.CUT] > 0].sort().values
    listed = records[truth.ids.long().unique(), Record.DISTANCE].sort().values
    assert torch.equal(listed, distances[: len(listed)])
    pictures = [few(BLEND)(records, lists, 70, 50, torch.ones(3), 3, False).image for lists in (found, truth)]
    same(*([picture] for picture in pictures))


@pytest.mark.parametrize("model", ["pinhole", "equirectangular"])
@pytest.mark.parametrize("basis", [0, 8])
def test_projection(basis: int, model: str) -> None:
    """Some Gaussians are behind the camera, without a size, or not finite, and the pose has a gradient."""
    torch.manual_seed(5)
    means = 2 * torch.randn(60, 3).double()
    rows = [torch.randn(60, 3) - 2, torch.randn(60, 4), torch.randn(60), torch.rand(60, 3), torch.rand(60, 3, 8)]
    given = [means, *(row.double() for row in rows)]
    given[0][3, 1], given[1][4, 0], given[2][5], given[5][6, 2, 7] = torch.nan, torch.inf, 0.0, torch.nan
    found = []
    for form in (few(PROJECT), project_reference):
        leaves = [values.clone().requires_grad_() for values in (*given, torch.eye(3, 4).double())]
        by: dict[str, Any] = {"antialiased": True, "model": model, "unscented": model != "pinhole"}
        camera = SplatCamera(leaves[-1], (60.0, 62.0, 35.0, 25.0), 70, 50, **by)
        records, dropped = form(*leaves[:-1], camera, basis)
        columns = torch.cat([records[:, : Record.CUT], records[:, Record.RED : Record.NORMAL_X]], 1)
        (columns * torch.linspace(-1, 1, 10).double().cos()).square().sum().backward()
        found.append([records, torch.as_tensor(dropped), *(leaf.grad for leaf in leaves)])
    assert bool((found[1][0][:, Record.OPACITY] > 0).any())
    assert bool((found[1][0][:, Record.OPACITY] == 0).any())
    assert int(found[0][1]) == (4 if basis else 3)
    same(*found)


@pytest.mark.parametrize("pairs", [2**24, 2**12])
@pytest.mark.parametrize("content", CHANNELS)
def test_blending(content: str, pairs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """All tiles at once, and a few at a time, which are computed again for the gradient."""
    monkeypatch.setattr(blend, "MAX_PAIRS", pairs)
    records, camera = splats()
    lists = tile_lists_reference(records, camera.width, camera.height)
    found = []
    for form in (few(BLEND), blend_reference):
        leaf = records.clone().requires_grad_()
        drawn = form(leaf, lists, 70, 50, torch.tensor([0.2, 0.5, 1.0]), CHANNELS[content], True)
        assert drawn.median is not None
        (drawn.image.square().sum() + drawn.transmittance.sum()).backward()
        found.append([*drawn, leaf.grad])
    same(*found)
    assert bool((found[0][1] < 0.1).any())


def test_nothing_to_blend() -> None:
    records, _ = splats()
    none = TileLists(torch.zeros(21, dtype=torch.int32), *(torch.zeros(0, dtype=torch.int32) for _ in range(3)))
    drawn = few(BLEND)(records, none, 70, 50, torch.tensor([0.2, 0.5, 1.0]), 3, False)
    assert drawn.image.shape == (50, 70, 3)
    assert torch.equal(drawn.image[9, 9].float(), torch.tensor([0.2, 0.5, 1.0]))
    assert bool((drawn.transmittance == 1).all())


def exponential(tangents: Tensor, screw: bool) -> Tensor:
    """The first forty terms of the power series of the matrix exponential."""
    w, zero = tangents[:, 3:], torch.zeros_like(tangents[:, 0])
    rows = [zero, -w[:, 2], w[:, 1], w[:, 2], zero, -w[:, 0], -w[:, 1], w[:, 0], zero]
    generator = torch.nn.functional.pad(torch.stack(rows, -1).view(-1, 3, 3), (0, 1, 0, 1))
    generator = generator + torch.nn.functional.pad(tangents[:, :3, None], (3, 0, 0, 1)) * screw
    total = term = torch.eye(4, dtype=tangents.dtype).expand_as(generator)
    for power in range(1, 40):
        term = term @ generator / power
        total = total + term
    return total[:, :3] if screw else torch.cat([total[:, :3, :3], tangents[:, :3, None]], -1)


@pytest.mark.parametrize("screw", [False, True])
def test_rigid_motions(screw: bool) -> None:
    """Values, gradients and gradients of these, from no angle at all to more than half a turn."""
    angles = torch.tensor([0.0, 1e-9, 1e-4, 0.1, 0.999, 1.001, 2.0, 4.0], dtype=torch.float64)
    directions = torch.nn.functional.normalize(torch.randn(8, 3, dtype=torch.float64), dim=-1)
    tangents = torch.cat([torch.randn(8, 3, dtype=torch.float64), angles[:, None] * directions], dim=-1)
    truth = derived(lambda x: exponential(x, screw), tangents)
    closed = RIGID_MOTIONS.implementations[0].run
    for run in (closed, RIGID_MOTIONS.reference.run):
        same(derived(lambda x, run=run: run(x, screw), tangents), truth)
    single = closed(tangents.float(), screw)
    torch.testing.assert_close(single.double(), truth[0], rtol=1e-5, atol=1e-5)

"""Lists of the Gaussians that tiles show: complete, sorted, and with slots that are a permutation."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerfloom.kernels.splats.project import RECORD, Record, project_gaussians
from nerfloom.kernels.splats.tiles import TILE, TILES, TileLists, tile_lists, tile_lists_reference
from tests.kernels.compiled import needs_kernels
from tests.kernels.splat_truth import camera, scene
from tests.kernels.test_few_operations import few

Form = Callable[[Tensor, int, int], TileLists]
WIDTHS, REACHES = [Record.U_X, Record.V_Y], [Record.REACH_X, Record.REACH_Y]
SIZES = [(1, 1), (16, 16), (17, 33), (64, 48), (130, 7)]
FORMS = pytest.mark.parametrize("form", [pytest.param(tile_lists, marks=needs_kernels), tile_lists_reference])


def records_of(given: list[Tensor], width: int, height: int) -> Tensor:
    *parameters, pose = given
    return project_gaussians(*parameters, replace(camera(width, height), pose=pose))[0]


def tiles_of(lists: TileLists) -> Tensor:
    """Return the tile of each entry."""
    return torch.repeat_interleave(lists.offsets.diff().long())


def needed(records: Tensor, width: int, height: int) -> Tensor:
    """Return (N, T) bool: whether a Gaussian's alpha is at least 1/255, and surely so, at a pixel of a tile."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    tile = (y // TILE * columns + x // TILE).flatten()
    r = records.double()[:, :, None]
    dx, dy = x.flatten() + 0.5 - r[:, 0], y.flatten() + 0.5 - r[:, 1]
    q = (r[:, Record.U_X] * dx + r[:, Record.U_Y] * dy) ** 2 + (r[:, Record.V_Y] * dy) ** 2
    alpha = r[:, Record.OPACITY] * torch.exp(-q)
    found = torch.zeros(len(records), columns * rows)
    found.index_add_(1, tile, (alpha * 255 > 1 + 1e-3).float())
    return found > 0


def check(lists: TileLists, records: Tensor, width: int, height: int) -> Tensor:
    """Check the lists' form and order. Returns (N, T) bool: whether a Gaussian is in a tile's list."""
    count, entries = len(records), len(lists.ids)
    tiles = -(-width // TILE) * -(-height // TILE)
    assert all(part.dtype == torch.int32 for part in lists[:4])
    assert [len(part) for part in lists[:4]] == [tiles + 1, entries, entries, count + 1]
    for starts in (lists.offsets, lists.firsts):
        assert starts[0] == 0
        assert starts[-1] == entries
        assert bool((starts.diff() >= 0).all())
    tile, ids = tiles_of(lists), lists.ids.long()
    listed = torch.zeros(count, tiles, dtype=torch.bool)
    listed[ids, tile] = True
    assert int(listed.sum()) == entries  # none twice
    assert bool((records[ids, Record.CUT] > 0).all())
    near, far = records[ids[:-1], Record.DISTANCE], records[ids[1:], Record.DISTANCE]
    ordered = (near < far) | ((near == far) & (ids[:-1] < ids[1:]))
    assert bool((ordered | (tile[:-1] != tile[1:])).all())
    # Slots are sorted by Gaussian, and within one by tile.
    place = torch.empty(entries, dtype=torch.long)
    place[lists.slots.long()] = torch.arange(entries)
    assert torch.equal(ids[place], torch.repeat_interleave(lists.firsts.diff().long()))
    assert torch.equal(tile[place], listed.nonzero()[:, 1])
    return listed


@FORMS
@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("larger", [-2.0, 0.0, 2.0])
def test_lists_are_complete_and_sorted(form: Form, size: tuple[int, int], larger: float) -> None:
    torch.manual_seed(0)
    given = scene(300)
    given[1] += larger
    records = records_of(given, *size)
    listed = check(form(records, *size), records, *size)
    assert not (needed(records, *size) & ~listed).any()
    assert bool(listed.any())


@needs_kernels
def test_needles_are_listed_where_they_are_and_hardly_elsewhere() -> None:
    """The box around a slanted needle has many more tiles than it touches."""
    torch.manual_seed(1)
    given = scene(200)
    given[1] = torch.tensor([0.0, -6.0, -6.0]).expand(200, 3).contiguous()
    records = records_of(given, 128, 96)
    listed = check(tile_lists(records, 128, 96), records, 128, 96)
    boxes = check(tile_lists_reference(records, 128, 96), records, 128, 96)
    must = needed(records, 128, 96)
    assert not (must & ~listed).any()
    assert not (listed & ~boxes).any()
    assert must.sum() <= listed.sum() < 1.2 * must.sum() < 0.8 * boxes.sum()


@pytest.mark.parametrize("form", [pytest.param(tile_lists, marks=needs_kernels), tile_lists_reference, few(TILES)])
def test_lists_are_sorted_by_keys_that_are_given(form: Callable[..., TileLists]) -> None:
    """Distances that are wrong do not matter then, and as keys they make the lists that they make by themselves."""
    torch.manual_seed(3)
    records = records_of(scene(300), 64, 48)
    keys = torch.rand(300) + 1e-3
    given = torch.stack([torch.zeros(300), keys], 1)[:, 1]  # not next to each other in memory
    found, same = form(records, 64, 48, keys=given), form(records, 64, 48, keys=records[:, Record.DISTANCE].clone())
    assert all(torch.equal(one, other) for one, other in zip(same[:4], form(records, 64, 48)[:4], strict=True))
    assert not torch.equal(found.ids, same.ids)
    records[:, Record.DISTANCE] = keys
    check(found, records, 64, 48)
    with pytest.raises(ValueError, match="300 Gaussians are sorted by as many keys"):
        tile_lists(records, 64, 48, keys=keys[:4])


@FORMS
def test_ties_are_in_the_order_of_the_indices(form: Form) -> None:
    torch.manual_seed(2)
    given = scene(500)
    records = records_of(given, 40, 40)
    records[:, Record.DISTANCE] = torch.randint(1, 4, (500,)).float()
    check(form(records, 40, 40), records, 40, 40)


@needs_kernels
def test_distances_of_all_magnitudes_are_sorted() -> None:
    """All bits of the keys count."""
    torch.manual_seed(3)
    records = torch.zeros(4000, RECORD)
    records[:, :2], records[:, WIDTHS], records[:, REACHES] = 8.0, 0.1, 22.0
    records[:, Record.OPACITY], records[:, Record.CUT] = 0.5, 4.8
    distances = torch.logspace(-30, 30, 4000)
    distances[1000:2000] = 1 + torch.arange(1000) * 2.0**-23
    records[:, Record.DISTANCE] = distances[torch.randperm(4000)]
    check(tile_lists(records, 16, 16), records, 16, 16)


@needs_kernels
def test_the_same_lists_on_any_number_of_threads() -> None:
    torch.manual_seed(4)
    given = scene(7000)
    records, before = records_of(given, 150, 100), torch.get_num_threads()
    found = []
    try:
        for threads in (1, 2, 3, 7):
            torch.set_num_threads(threads)
            found.append(tile_lists(records, 150, 100))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for lists in found[1:] for a, b in zip(lists[:4], found[0][:4], strict=True))


@needs_kernels
def test_records_in_another_order_in_memory() -> None:
    torch.manual_seed(5)
    records = records_of(scene(3000), 100, 80)
    expected = tile_lists(records, 100, 80)
    found = tile_lists(records.t().contiguous().t(), 100, 80)
    assert all(torch.equal(a, b) for a, b in zip(found[:4], expected[:4], strict=True))


@FORMS
@pytest.mark.parametrize("count", [0, 9])
def test_lists_of_nothing(form: Form, count: int) -> None:
    lists = form(torch.zeros(count, RECORD), 20, 40)
    assert not check(lists, torch.zeros(count, RECORD), 20, 40).any()


@needs_kernels
def test_more_entries_than_indices_are_refused() -> None:
    """Each of 8192 Gaussians fills an image of 2^18 tiles."""
    records = torch.zeros(8192, RECORD)
    records[:, WIDTHS], records[:, [Record.CUT, Record.DISTANCE]], records[:, REACHES] = 1e-6, 1.0, 1e6
    with pytest.raises(ValueError, match="more than 2\\^31 Gaussians on the image's tiles"):
        tile_lists(records, 512 * TILE, 512 * TILE)

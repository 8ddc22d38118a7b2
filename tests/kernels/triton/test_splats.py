"""Gaussians: their projection, the lists of tiles, and their blending."""

import math

import pytest
import torch
from torch import Tensor

from nerfloom.kernels.splats.blend import blend
from nerfloom.kernels.splats.project import RECORD, Record, SplatCamera, project_gaussians, project_reference
from nerfloom.kernels.splats.tiles import TileLists, tile_lists, tile_lists_reference
from tests.kernels.splat_truth import camera, growth_error, scene
from tests.kernels.test_splat_lists import check, needed
from tests.kernels.triton.compared import DEVICE, compare

WIDTH, HEIGHT = 37, 30
WIDTHS, REACHES = [Record.U_X, Record.V_Y], [Record.REACH_X, Record.REACH_Y]
NAMES = "means log_scales rotations logits colors harmonics pose"


def gaussians(count: int, harmonics: int = 3) -> dict[str, Tensor]:
    """Gaussians in front of a camera that is turned a little, some of them beyond the image's edge."""
    torch.manual_seed(0)
    turn = torch.linalg.qr(torch.eye(3) + 0.1 * torch.randn(3, 3)).Q
    turn = turn * turn.diagonal().sign()
    rows = (torch.randn(count, 3), torch.randn(count, 3) / 2 - 1.5, torch.randn(count, 4), torch.randn(count) + 1)
    pose = torch.cat([turn, torch.tensor([[0.1], [-0.2], [4.0]])], 1)
    values = (*rows, torch.randn(count, 3), torch.rand(count, 3, harmonics) / 3, pose)
    return dict(zip(NAMES.split(), values, strict=True))


def projected(antialiased: bool = False, degree: int = 3):
    def run(pose: Tensor, **rows: Tensor) -> tuple[Tensor, Tensor]:
        camera = SplatCamera(pose, (30.0, 32.0, 20.0, 15.0), WIDTH, HEIGHT, antialiased=antialiased)
        records, dropped = project_gaussians(**rows, camera=camera, degree=degree)
        # Bounds and normals pass no gradient on.
        shape, bounds, seen, normals = records.split([Record.CUT, Record.RED - Record.CUT, 4, 4], 1)
        records = torch.cat([shape, bounds.detach(), seen, normals.detach()], 1)
        return records, torch.as_tensor(dropped, dtype=torch.int64)

    return run


@pytest.mark.parametrize(
    ("count", "harmonics", "degree", "antialiased"),
    [(0, 3, 3, False), (1, 0, 3, False), (60, 15, 3, True), (40, 8, 1, False)],
)
def test_projection(count: int, harmonics: int, degree: int, antialiased: bool) -> None:
    given = gaussians(count, harmonics)
    followed = NAMES if degree == 3 and harmonics else NAMES.replace(" harmonics", "")
    compare(projected(antialiased, degree), given, followed if count else "")


def test_extremes_of_projection() -> None:
    """Behind the camera, beside it, of no size and of all, hardly visible, with NaN, infinity, or no rotation."""
    given = gaussians(12, 8)
    given["means"][0], given["means"][1] = torch.tensor([0.0, 0.0, -9.0]), torch.tensor([90.0, 0.0, 1.0])
    given["log_scales"][2], given["log_scales"][3] = -30.0, 3.0
    given["logits"][4], given["logits"][5], given["logits"][6] = -100.0, 100.0, math.inf
    given["means"][7, 1], given["rotations"][8], given["harmonics"][9, 0, 0] = math.nan, 0.0, math.nan
    given["rotations"][10] *= 1e-6
    found = compare(projected(), given, NAMES)
    assert found[1] == 4
    for gradient in found[2:-1]:
        assert bool(gradient.isfinite().all())
        assert not gradient[[0, 1, 4, 6, 7, 8, 9]].any()


def test_what_overflows_is_not_visible() -> None:
    given = {name: value.to(DEVICE) for name, value in gaussians(3).items()}
    given["log_scales"][1] = 100.0
    records, dropped = projected()(**given)
    assert dropped == 0
    assert not records[1].any()
    assert bool(records.isfinite().all())


def test_lenses_are_the_references() -> None:
    from nerfloom.geometry.lenses import Distortion

    given = gaussians(5)
    lens = Distortion.of("opencv", torch.tensor([[-0.1, 0.01, 0, 0, 0, 0, 0, 0, 0]], dtype=torch.float64))

    def run(pose: Tensor, **rows: Tensor) -> Tensor:
        seen = SplatCamera(pose, (30.0, 32.0, 20.0, 15.0), 37, 30, lens=lens, model="opencv")
        return project_gaussians(**rows, camera=seen)[0]

    if DEVICE.type == "cpu":
        compare(run, given, expected="reference", tolerance=1e-4)


def records_of(given: dict[str, Tensor], width: int = WIDTH, height: int = HEIGHT) -> Tensor:
    *rows, pose = given.values()
    camera = SplatCamera(pose, (30.0, 32.0, width / 2, height / 2), width, height)
    return project_reference(*rows, camera, 0)[0]


@pytest.mark.parametrize(("count", "width", "height"), [(0, 20, 9), (1, 1, 1), (50, 37, 30), (40, 130, 7)])
def test_lists(count: int, width: int, height: int) -> None:
    records = records_of(gaussians(count), width, height)
    records[: count // 5, Record.CUT] = 0  # not visible
    found = TileLists(*(part.cpu() for part in tile_lists(records.to(DEVICE), width, height)[:4]))
    listed = check(found, records, width, height)
    assert not (needed(records, width, height) & (records[:, Record.CUT :] > 0)[:, :1] & ~listed).any()
    boxes = check(tile_lists_reference(records, width, height), records, width, height)
    assert not (listed & ~boxes).any()


def test_lists_sorted_by_other_keys() -> None:
    records = records_of(gaussians(50))
    keys = torch.rand(50, generator=torch.Generator().manual_seed(1)) + 0.1
    found = tile_lists(records.to(DEVICE), WIDTH, HEIGHT, keys=keys.to(DEVICE))
    records[:, Record.DISTANCE] = keys  # where the distance is
    check(TileLists(*(part.cpu() for part in found[:4])), records, WIDTH, HEIGHT)


@pytest.mark.parametrize("room", [0, 40, 400])
def test_lists_with_little_room(room: int) -> None:
    """The first Gaussians are listed as they are with room for all; nothing is written beyond it."""
    records = records_of(gaussians(50))
    full, found = (tile_lists(records.to(DEVICE), WIDTH, HEIGHT, True, given) for given in (None, room))
    entries = int(found.offsets[-1])
    assert len(found.ids) == len(found.slots) == room
    assert found.needed == len(full.ids)
    assert (entries == len(full.ids)) == (room == 400)
    part = TileLists(found.offsets.cpu(), found.ids[:entries].cpu(), found.slots[:entries].cpu(), found.firsts.cpu())
    check(part, records, WIDTH, HEIGHT)
    last = int((full.firsts <= room).sum()) - 1
    assert torch.equal(found.firsts, full.firsts.clamp(max=full.firsts[last]))
    assert torch.equal(part.ids, full.ids[full.ids < last].cpu())


def blended(width: int, height: int, channels: int, median: bool):
    def run(records: Tensor, background: Tensor) -> list[Tensor]:
        lists = tile_lists_reference(records, width, height)
        # The columns of bounds get the sums of absolute gradients.
        shape, bounds, rest = records.split([Record.CUT, Record.RED - Record.CUT, 8], 1)
        records = torch.cat([shape, bounds.detach(), rest], 1)
        found = blend(records, lists, width, height, background, channels, median)
        return [part for part in found if part is not None]

    return run


@pytest.mark.parametrize(
    ("count", "width", "height", "channels"), [(0, 5, 3, 3), (1, 1, 1, 4), (20, 17, 9, 4), (20, 16, 16, 7)]
)
def test_blending(count: int, width: int, height: int, channels: int) -> None:
    given = {"records": records_of(gaussians(count), width, height), "background": torch.tensor([0.2, 0.5, 1.0])}
    compare(blended(width, height, channels, median=channels > 3), given, "records" if channels < 7 and count else "")


def test_extremes_of_blending() -> None:
    """A stack of walls ends light within a batch, with a pixel's alpha at its bound; and there are thin veils."""
    records = torch.zeros(30, RECORD)
    records[:, :2], records[:, WIDTHS] = torch.tensor([8.5, 7.5]), 0.05
    records[:, Record.OPACITY] = torch.tensor([0.004, 0.9, 1.0, 0.5, 0.99, 0.3] * 5)
    records[:, Record.CUT], records[:, REACHES] = (records[:, Record.OPACITY] * 255).log(), 40.0
    records[:, Record.RED : Record.DISTANCE] = torch.rand(30, 3, generator=torch.Generator().manual_seed(0))
    records[:, Record.DISTANCE] = torch.arange(30.0) + 1
    given = {"records": records, "background": torch.zeros(3)}
    compare(blended(16, 16, 4, median=True), given, "records", tolerance=1e-4)  # at most 1e-4 of the light is left


@pytest.mark.parametrize("size", [(37, 41), pytest.param((60, 20), marks=pytest.mark.slow)])
def test_growth_is_by_the_pixels_absolute_gradients(size: tuple[int, int]) -> None:
    """The other backends are tested in tests/kernels/test_growth.py."""
    from nerfloom.kernels.splats.blend_triton import blend as triton_blend

    torch.manual_seed(5)
    assert growth_error(triton_blend, scene(80), camera(*size), DEVICE) < 1e-5


def test_sums_of_absolute_gradients() -> None:
    """Two pixels that pull a Gaussian apart: the gradients of its centre cancel, and their magnitudes do not."""
    records = torch.zeros(1, RECORD, device=DEVICE)
    records[:, :2], records[:, WIDTHS], records[:, Record.OPACITY] = 8.0, 0.3, 0.5
    records[:, Record.CUT], records[:, REACHES] = math.log(127), 8.0
    records[:, Record.RED], records[:, Record.DISTANCE] = 1.0, 1.0
    records.requires_grad_()
    lists = tile_lists(records, 16, 16)
    image = blend(records, lists, 16, 16, torch.zeros(3, device=DEVICE)).image
    (gradient,) = torch.autograd.grad(image.sum(), records)
    assert gradient[0, :2].abs().max() < 1e-5
    assert gradient[0, Record.CUT] > 0.1
    torch.testing.assert_close(gradient[0, Record.CUT], gradient[0, Record.REACH_X])


def test_kernels_have_the_same_columns_of_a_record() -> None:
    from nerfloom.kernels.splats import record_triton

    assert all(getattr(record_triton, column.name).value == column for column in Record)
    assert record_triton.RECORD.value == RECORD == len(Record)

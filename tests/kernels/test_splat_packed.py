"""Gaussians packed to be drawn many times, against the projection of rows."""

import pytest
import torch

from nerfloom.kernels.splats.packed import PACK, PackedGaussians, pack_gaussians, project_packed
from nerfloom.kernels.splats.project import Record, SplatCamera, project_gaussians
from tests.kernels.compiled import needs_kernels
from tests.kernels.splat_truth import camera, scene

pytestmark = needs_kernels


def posed(lens: str, pose: torch.Tensor, **settings: object) -> SplatCamera:
    given = camera(57, 43, lens, **settings)
    return SplatCamera(**{**vars(given), "pose": pose})


@pytest.mark.parametrize("lens", ["", "opencv", "fisheye"])
@pytest.mark.parametrize(
    ("count", "harmonics", "degree"), [(1, 15, 3), (16, 3, 1), (333, 15, 3), (334, 8, 1), (47, 0, 3)]
)
def test_records_are_those_of_rows(lens: str, count: int, harmonics: int, degree: int) -> None:
    """Some are needles, giants, behind the camera or beside the image; compilers round in another order."""
    torch.manual_seed(count)
    *rows, pose = scene(count, harmonics, spread=4.0)
    rows[0][::3, 2] -= 4
    rows[1][::5, 0] += 3
    rows[1][::7] += 4
    seen = posed(lens, pose, antialiased=count % 2 == 0)
    found = project_packed(pack_gaussians(*rows), seen, degree)
    truth = project_gaussians(*rows, camera=seen, degree=degree)[0]
    assert found.shape == (-(-count // PACK) * PACK, truth.shape[1])
    shown = truth[:, Record.CUT] > 0
    assert count < 16 or 0 < int(shown.sum()) < count
    torch.testing.assert_close(found[:count][shown], truth[shown], rtol=1e-4, atol=1e-5)
    assert not bool((found[:count, Record.CUT] > 0)[~shown].any())
    assert not bool((found[count:, Record.CUT] > 0).any())


def test_bfloat16_changes_colours_by_its_rounding() -> None:
    torch.manual_seed(0)
    *rows, pose = scene(200)
    seen = posed("", pose)
    exact, rounded = (project_packed(pack_gaussians(*rows, dtype=t), seen) for t in (torch.float32, torch.bfloat16))
    shown = exact[:, Record.CUT] > 0  # the other rows are undefined
    assert torch.equal(rounded[:, Record.CUT] > 0, shown)
    exact, rounded = exact[shown], rounded[shown]
    assert torch.equal(exact[:, :8], rounded[:, :8])
    # 15 coefficients, each off by 2^-9 of itself, times harmonics of at most 1.6
    bound = rows[5].abs().sum(-1).max() * 2**-9 * 1.6
    difference = (exact[:, 8:11] - rounded[:, 8:11]).abs().max()
    assert 0 < difference < bound


def ring(count: int) -> list[torch.Tensor]:
    """Small Gaussians all around the camera, one block after the other in the direction of its heading."""
    *rows, _ = scene(count * PACK)
    heading = torch.linspace(0, 2 * torch.pi, count + 1)[:-1].repeat_interleave(PACK)
    rows[0] = 4 * torch.stack([heading.sin(), 0 * heading, heading.cos()], -1) + 0.05 * torch.randn(count * PACK, 3)
    rows[1] -= 1
    rows[3] += 3
    return rows


def test_blocks_whose_balls_the_image_does_not_show_are_not_read() -> None:
    """They are not read even if their Gaussians, against the ball, are in the middle of the image."""
    torch.manual_seed(0)
    seen, packed = camera(57, 43), pack_gaussians(*ring(64))
    truth = project_packed(packed, seen)
    shows = (truth[:, Record.CUT] > 0).view(-1, PACK).any(1)
    assert 4 < int(shows.sum()) < 20
    away = ~(shows | shows.roll(1) | shows.roll(-1))
    values = packed.values.clone()
    values[away] = packed.values[0]
    found = project_packed(PackedGaussians(values, packed.harmonics, packed.balls), seen)
    shown = truth[:, Record.CUT] > 0
    assert torch.equal(found[:, Record.CUT] > 0, shown)
    assert torch.equal(found[shown], truth[shown])


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_any_number_of_threads(threads: int) -> None:
    torch.manual_seed(0)
    *rows, pose = scene(5_000)
    packed, seen = pack_gaussians(*rows), posed("", pose)
    truth = project_packed(packed, seen)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        found = project_packed(packed, seen)
    finally:
        torch.set_num_threads(before)
    shown = truth[:, Record.CUT] > 0
    assert torch.equal(found[:, Record.CUT] > 0, shown)
    assert torch.equal(found[shown], truth[shown])

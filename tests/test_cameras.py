"""Cameras against cases worked out by hand."""

import math

import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.cameras.cameras import Cameras, check_pose, subpixels
from tests.kernels.compiled import needs_kernels


def camera(pose: torch.Tensor | None = None) -> Cameras:
    """A 4x2 image, focal lengths 2 and 4, principal point (2.5, 0.5)."""
    pose = torch.eye(4)[:3] if pose is None else pose
    values = [torch.tensor([v]) for v in (2.0, 4.0, 2.5, 0.5)]
    return Cameras(pose[None], *values, torch.tensor([4]), torch.tensor([2]))


def test_rays_by_hand() -> None:
    """Pixel (2, 0) is the principal ray. Pixel (0, 1): x = (0.5 - 2.5) / 2 = -1, y = (1.5 - 0.5) / 4 = 1/4, down."""
    zero = torch.zeros(2, dtype=torch.long)
    rays = camera().rays(zero, torch.tensor([2, 0]), torch.tensor([0, 1]), 0.1, 9.0)
    length = math.sqrt(1 + 1 / 16 + 1)
    expected = torch.tensor([[0, 0, -1.0], [-1 / length, -0.25 / length, -1 / length]])
    error = (rays.directions - expected).abs().max().item()
    print(f"camera rays: off the hand-computed ones by {error:.1e}")
    assert error < 1e-7
    assert rays.nears.tolist() == pytest.approx([0.1, 0.1])
    assert rays.fars.tolist() == [9, 9]
    assert rays.pixel_radii is not None
    assert rays.pixel_radii.tolist() == pytest.approx([2 / math.sqrt(12) / 2, 2 / math.sqrt(12) / 2 / length])


def test_a_turned_and_moved_camera() -> None:
    """A quarter turn about z: x becomes y, y becomes -x. Looks down still."""
    pose = torch.tensor([[0.0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7]])
    rays = camera(pose).rays(torch.tensor([0]), torch.tensor([0]), torch.tensor([1]), 0.0, 1.0)
    length = math.sqrt(1 + 1 / 16 + 1)
    torch.testing.assert_close(rays.origins, torch.tensor([[5.0, 6, 7]]))
    torch.testing.assert_close(rays.directions, torch.tensor([[0.25, -1, -1]]) / length)


def test_image_rays_run_row_by_row() -> None:
    cameras = camera()
    rays = cameras.pixel_rays(cameras.image_pixels(0), 0.0, 1.0)
    assert len(rays) == 8
    one = cameras.rays(torch.tensor([0]), torch.tensor([1]), torch.tensor([1]), 0.0, 1.0)
    torch.testing.assert_close(rays.directions[5:6], one.directions)
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(8))


@pytest.mark.parametrize("count", [1, 4, 9, 16])
def test_subpixels_are_a_turned_grid(count: int) -> None:
    """One place in each of `count` columns and rows, as far from each other as a grid of that many can be."""
    places = subpixels(count)
    middles = (torch.arange(count) + 0.5) / count - 0.5
    for axis in (0, 1):
        torch.testing.assert_close(places[:, axis].sort().values, middles)
    if count > 1:
        assert float(torch.pdist(places).min()) == pytest.approx(math.sqrt(count + 1) / count)


@pytest.mark.parametrize("count", [0, 2, 5, 15])
def test_no_other_number_of_subpixels(count: int) -> None:
    with pytest.raises(ValueError, match="must be a square number"):
        subpixels(count)


@needs_kernels
@pytest.mark.parametrize("count", [1, 4])
def test_compiled_rays_are_those_of_torch(count: int) -> None:
    generator = torch.Generator().manual_seed(0)
    cameras = Cameras(
        torch.linalg.qr(torch.randn(3, 3, 3, generator=generator)).Q[:, :, [0, 1, 2, 2]],
        fx=torch.tensor([5.0, 6.0, 7.0]),
        fy=torch.tensor([6.0, 5.0, 8.0]),
        cx=torch.tensor([2.0, 3.5, 1.0]),
        cy=torch.tensor([3.0, 2.5, 1.0]),
        widths=torch.tensor([4, 7, 3]),
        heights=torch.tensor([6, 5, 2]),
    )
    flat = torch.arange(4 * 6 + 7 * 5 + 3 * 2)
    times = torch.tensor([0.0, 0.5, 1.0])
    assert cameras.image_pixels(1).tolist() == list(range(24, 59))
    one = cameras.pixel_rays(flat, 0.1, 9.0, times, subpixels(count))
    two = cameras.pixel_rays_reference(flat, 0.1, 9.0, times, subpixels(count))
    assert len(one) == len(flat) * count
    for name, value in vars(two).items():
        torch.testing.assert_close(getattr(one, name), value)
    every_other = cameras.pixel_rays(flat[::2], 0.1, 9.0, times)  # of indices that do not stand together
    torch.testing.assert_close(every_other.directions, cameras.pixel_rays(flat, 0.1, 9.0, times).directions[::2])
    middle = two.directions / -(cameras.camera_to_worlds[two.camera_indices][:, :, 2] * two.directions).sum(-1)[:, None]
    centre = cameras.pixel_rays_reference(flat, 0.1, 9.0).directions
    found = torch.nn.functional.normalize(middle.view(len(flat), count, 3).mean(1), dim=-1)
    torch.testing.assert_close(found, centre)  # the middle of a pixel's rays, where they meet the image plane


def test_scaled_cameras_see_the_same() -> None:
    """The corner shared by four small pixels is the centre of the large pixel that holds them."""
    large, small = camera(), camera().scaled(0.5)
    assert (small.widths.item(), small.heights.item()) == (2, 1)
    a = large.rays(torch.tensor([0]), torch.tensor([0.5]), torch.tensor([0.5]), 0, 1)
    b = small.rays(torch.tensor([0]), torch.tensor([0]), torch.tensor([0]), 0, 1)
    torch.testing.assert_close(a.directions, b.directions)


def test_autocast_does_not_round_rays() -> None:
    torch.manual_seed(0)
    rotation = torch.linalg.qr(torch.randn(3, 3)).Q
    pose = torch.cat([rotation * torch.linalg.det(rotation).sign(), torch.zeros(3, 1)], dim=1)
    exact = camera(pose).pixel_rays(torch.arange(8), 0.0, 1.0).directions
    with torch.autocast("cpu", torch.bfloat16):
        cast = camera(pose).pixel_rays(torch.arange(8), 0.0, 1.0).directions
    torch.testing.assert_close(cast, exact, rtol=0, atol=0)


def test_times_and_indices_travel() -> None:
    cameras = camera()[torch.tensor([0, 0, 0])]
    rays = cameras.rays(torch.tensor([2, 0]), torch.zeros(2), torch.zeros(2), 0, 1, torch.tensor([0.0, 0.5, 1.0]))
    assert rays.times is not None
    assert rays.times.tolist() == [1.0, 0.0]
    assert rays.camera_indices is not None
    assert rays.camera_indices.tolist() == [2, 0]
    assert len(rays[torch.tensor([True, False])]) == 1


def broken(change: str) -> torch.Tensor:
    pose = torch.eye(4)
    if change == "nan":
        pose[0, 3] = math.nan
    elif change == "inf":
        pose[1, 1] = math.inf
    elif change == "scaled":
        pose[:3, :3] *= 1.1
    elif change == "mirrored":
        pose[0, 0] = -1
    elif change == "overflow":
        pose = pose.double()
        pose[:2, :2] = torch.tensor([[1e200, 1e200], [1e200, -1e200]], dtype=torch.float64)
    elif change == "shape":
        pose = pose[:2]
    return pose


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("nan", "not finite"),
        ("inf", "not finite"),
        ("scaled", "not rigid"),
        ("mirrored", "not rigid"),
        ("overflow", "not rigid"),
        ("shape", "4x4"),
    ],
)
def test_bad_poses_are_refused_by_name(change: str, words: str) -> None:
    with pytest.raises(DataError, match=f"frame 7.*{words}"):
        check_pose(broken(change), "frame 7")


def test_good_poses_pass() -> None:
    for pose in (torch.eye(4), torch.eye(4)[:3]):
        check_pose(pose, "frame 7")
        assert pose.isfinite().all()

"""Visibility networks: labels in closed form, a network trained on a wall, and left-out blocks."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from nerfloom.base.errors import DataError
from nerfloom.blocks.blend import near_shares
from nerfloom.blocks.composed import Blocks, Opened
from nerfloom.blocks.sights import SURFACE, Sights, queries
from nerfloom.blocks.visibility import SHARES, Visibility, points_in_view, read_visibility, write_visibility
from nerfloom.cameras.view import View
from nerfloom.training.block_visibility import fitted
from tests.blocks.fakes import block, cameras, placement, plain, scene

AHEAD = torch.tensor([0.0, 0.0, -1.0])
BLACK = torch.zeros(3)


def wall(distance: float = 2.0, opacity: float = 0.9, stride: int = 3) -> Sights:
    """Two cameras, one unit apart along x, that look along -z at a sphere's inside around each."""
    picture = torch.full((8, 8), distance)
    opaque = torch.full((8, 8), opacity)
    return Sights(cameras([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)]), [picture] * 2, [opaque] * 2, [stride] * 2)


@pytest.mark.parametrize(
    ("point", "direction", "expected"),
    [
        ((0.0, 0.0, -1.0), AHEAD, 1.0),
        ((0.0, 0.0, -2.0 * SURFACE + 0.01), AHEAD, 1.0),  # on the surface
        ((0.0, 0.0, -2.5), AHEAD, 0.1),
        ((0.0, 0.0, 1.0), -AHEAD, 0.0),  # behind the cameras
        ((3.0, 0.0, -1.0), torch.tensor([3.0, 0.0, -1.0]) / math.sqrt(10), 0.0),  # beside both images
        ((0.0, 0.0, -1.0), torch.tensor([1.0, 0.0, 0.0]), 0.0),  # from where nobody looks
        ((0.0, 0.0, -1.0), torch.tensor([-1.0, 0.0, -1.0]) / math.sqrt(2), 0.0),  # outside of the second
        ((1.3, 0.0, -1.0), torch.tensor([0.3, 0.0, -1.0]) / math.sqrt(1.09), 1.0),  # seen by the second
    ],
)  # fmt: skip
def test_labels_in_closed_form(point: tuple[float, float, float], direction: Tensor, expected: float) -> None:
    found = wall().transmittance(torch.tensor([point]), direction[None])
    assert float(found) == pytest.approx(expected)


def test_a_pixel_of_a_small_picture_is_that_of_its_rows_and_columns() -> None:
    """Half of the image is near and half far: the border is where the image has it."""
    picture = torch.full((8, 8), 1.0)
    picture[:, 4:] = 3.0
    sights = Sights(cameras([(0.0, 0.0, 0.0)]), [picture], [torch.ones(8, 8)], [3])
    directions = torch.nn.functional.normalize(torch.tensor([[-0.1, 0.0, -1.0], [0.1, 0.0, -1.0]]), dim=-1)
    assert sights.transmittance(2 * directions, directions).tolist() == [0.0, 1.0]


def test_queries_are_near_the_cameras_and_half_of_them_in_images() -> None:
    seen = cameras([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)])
    points, directions = queries(seen, 5.0, 4000)
    assert points.shape == directions.shape == (4000, 3)
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(4000))
    assert float(points.norm(dim=-1).max()) < 2 * 5.0 + 1 + 5 * 0.1 * 5.0 * math.sqrt(3)
    ahead = (directions @ AHEAD) > 30 / math.sqrt(30**2 + 2 * 12**2)  # the cosine of an image's corner
    assert float(ahead.float().mean()) == pytest.approx(0.5 + 0.5 * 0.06, abs=0.06)


@pytest.mark.medium
def test_a_network_learns_what_was_seen() -> None:
    """Cameras in a circle of radius 0.3 look along -z at a wall at z = -2; the block has radius 4, at (10, 20, 30)."""
    angles = [2 * math.pi * number / 12 for number in range(12)]
    seen = cameras([(0.3 * math.cos(angle), 0.3 * math.sin(angle), 0.0) for angle in angles])
    pixels = torch.arange(64)
    rays = seen.rays(torch.zeros_like(pixels), pixels % 8 * 3 + 1, pixels // 8 * 3 + 1, 0.0, 1.0)
    depths = (2.0 / -rays.directions[:, 2]).view(8, 8)
    sights = Sights(seen, [depths] * 12, [torch.ones(8, 8)] * 12, [3] * 12)
    points, directions = queries(seen, 4.0, 2**15)
    shift = torch.tensor([10.0, 20.0, 30.0])
    labels = sights.transmittance(points, directions)
    network = fitted(Visibility((10.0, 20.0, 30.0), 4.0), points + shift, directions, labels)
    front, behind, never = (
        torch.tensor([[x, y, z] for x in (-0.3, 0.0, 0.3) for y in (-0.3, 0.0, 0.3)]) for z in (-1.2, -4.0, 3.0)
    )
    for points, direction, low, high in (
        (front, AHEAD, 0.7, 1.0),
        (behind, AHEAD, 0.0, 0.25),
        (never, -AHEAD, 0.0, 0.25),
        (front, -AHEAD, 0.0, 0.25),
    ):
        mean = float(network.of(points + shift, direction.expand(9, 3)).mean())
        print(f"{mean:.3f}, from {low} to {high}")
        assert low <= mean <= high


def test_points_of_a_view_are_on_its_rays_in_the_frame_of_the_input() -> None:
    whole = placement(2.0, (1.0, 0.0, 0.0), angle=math.pi / 2)
    view = View(cameras([(0.5, 1.0, -2.0)]), stride=8)
    points, directions = points_in_view(view, whole, reach=3.0)
    assert points.shape == directions.shape == (view.height * view.width * len(SHARES), 3)
    place = whole.original_points(torch.tensor([[0.5, 1.0, -2.0]]))
    away = points - place
    lengths = 3 * torch.tensor(SHARES, dtype=torch.float64).repeat(view.height * view.width)
    torch.testing.assert_close(away.norm(dim=-1), lengths, rtol=1e-5, atol=0)
    torch.testing.assert_close(away / away.norm(dim=-1, keepdim=True), directions, atol=1e-6, rtol=0)


class Known(Visibility):
    """Has the same transmittance everywhere."""

    def __init__(self, value: float) -> None:
        super().__init__((0.0, 0.0, 0.0), 1.0)
        self.value, self.asked = value, 0

    def of(self, points: Tensor, directions: Tensor) -> Tensor:
        self.asked += 1
        return torch.full((len(points),), self.value)


def test_a_block_that_has_not_seen_the_view_is_not_even_opened() -> None:
    models = plain(1.0, 0.0, 0.0), plain(0.0, 1.0, 0.0)
    networks = Known(0.9), Known(0.05)
    opened: list[int] = []

    def open_block(number: int) -> Opened:
        opened.append(number)
        return Opened(models[number], placement(1.0))

    blocks = [block((0.0, 0.0, 0.0), 5.0), block((4.0, 0.0, 0.0), 5.0)]
    model = Blocks(blocks, open_block, placement(1.0), scene(), lambda number: networks[number])
    picture = model.render_view(View(cameras([(2.5, 0.0, 0.0)])), BLACK)
    torch.testing.assert_close(picture.rgb[0, 0], torch.tensor([1.0, 0.0, 0.0]))
    assert set(opened) == {0}
    assert [network.asked for network in networks] == [1, 1]
    assert [len(shown.views) for shown in models] == [1, 0]  # no small picture is drawn


def test_without_a_network_for_each_block_pictures_decide() -> None:
    models = plain(1.0, 0.0, 0.0), plain(0.0, 1.0, 0.0)
    blocks = [block((0.0, 0.0, 0.0), 5.0), block((4.0, 0.0, 0.0), 5.0)]
    network = Known(0.05)
    model = Blocks(
        blocks,
        lambda number: Opened(models[number], placement(1.0)),
        placement(1.0),
        scene(),
        lambda number: network if number else None,
    )
    shares = model.shares(View(cameras([(2.5, 0.0, 0.0)])), BLACK)
    expected = near_shares(torch.tensor([2.5, 1.5]).double(), torch.tensor([5.0, 5.0]).double())
    assert shares[0] == pytest.approx(float(expected[0]))
    assert network.asked == 0


def test_what_is_written_is_read_and_damage_is_said(tmp_path: Path) -> None:
    network, file = Visibility((1.0, 2.0, 3.0), 4.0), tmp_path / "visibility.npz"
    with torch.no_grad():
        network.layers[0].weight.add_(0.5)  # type: ignore[operator, union-attr]
    write_visibility(file, network)
    found, points = read_visibility(file), torch.randn(50, 3)
    assert (found.center, found.radius) == ((1.0, 2.0, 3.0), 4.0)
    assert torch.equal(found.of(points, points), network.of(points, points))
    assert file.stat().st_size < 40_000
    with np.load(file) as content:
        arrays = dict(content)
    for name, value in (
        ("radius", np.array(-1.0)),
        ("center", np.array([0.0, np.nan, 1.0])),
        ("layers.1.weight", np.zeros((64, 63), np.float32)),
        ("layers.2.bias", np.full(1, 1e9, np.float32)),
    ):
        np.savez(file, **{**arrays, name: value})
        with pytest.raises(DataError, match=r"visibility\.npz is damaged: .*remove it, and run ns-blocks again"):
            read_visibility(file)
    file.write_bytes(b"no zip file")
    with pytest.raises(DataError, match="is damaged"):
        read_visibility(file)
    with pytest.raises(DataError, match="cannot read"):
        read_visibility(tmp_path / "missing.npz")

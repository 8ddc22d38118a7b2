"""Several blocks in one picture: colours, depths and opacity by hand, few blocks in memory, frames in float64."""

import gc
import weakref
from collections.abc import Sequence

import pytest
import torch

from nerfloom.blocks.blend import near_shares
from nerfloom.blocks.block import TrainedBlock
from nerfloom.blocks.composed import Blocks, Opened, few_in_memory
from nerfloom.blocks.matching import matched
from nerfloom.cameras.moved import moved_cameras
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.view import View
from tests.blocks.fakes import Drifted, Shown, block, cameras, placement, plain, scene

BLACK = torch.zeros(3)


def composed(
    blocks: Sequence[TrainedBlock], models: Sequence[Shown], placements: Sequence[Placement], whole: Placement
) -> Blocks:
    return Blocks(blocks, lambda number: Opened(models[number], placements[number]), whole, scene())


@pytest.fixture
def two() -> tuple[Blocks, Shown, Shown]:
    """Red at 0 and green at 4 along x of the input, each in a scene of its own; the whole scene has scale 0.5."""
    models = plain(1.0, 0.0, 0.0, distance=6.0), plain(0.0, 1.0, 0.0, distance=2.0)
    blocks = [block((0.0, 0.0, 0.0), 5.0), block((4.0, 0.0, 0.0), 5.0)]
    return composed(blocks, models, (placement(3.0), placement(1.0, angle=1.0)), placement(0.5)), *models


@pytest.mark.parametrize("x", [0.5, 1.0, 2.0, 3.1])
def test_two_blocks_of_one_colour_each_are_blended_exactly(x: float, two: tuple[Blocks, Shown, Shown]) -> None:
    model = two[0]
    red, green = near_shares(torch.tensor([x, 4 - x]).double(), torch.tensor([5.0, 5.0]).double()).tolist()
    picture = model.render_view(View(cameras([(0.5 * x, 0.0, 0.0)])), BLACK)
    assert picture.size == (24, 24)
    torch.testing.assert_close(picture.rgb[3, 5], torch.tensor([red, green, 0.0]), atol=2e-3, rtol=0)
    # Both surfaces are 2 units of the input away, 1 unit of the whole scene.
    torch.testing.assert_close(picture.depth[0, 0].item(), red * 1.0 + green * 1.0, atol=2e-3, rtol=0)
    torch.testing.assert_close(picture.accumulation[0, 0].item(), 1.0)


def test_in_the_middle_of_a_block_only_that_block_is_drawn(two: tuple[Blocks, Shown, Shown]) -> None:
    model, red, green = two
    view = View(cameras([(0.0, 0.0, 0.0)]))
    torch.testing.assert_close(model.render_view(view, BLACK).rgb[0, 0], torch.tensor([1.0, 0.0, 0.0]))
    assert (len(red.views), len(green.views)) == (1, 0)


def test_each_block_sees_the_camera_in_its_own_scene(two: tuple[Blocks, Shown, Shown]) -> None:
    model, red, green = two
    model.render_view(View(cameras([(1.0, 0.5, 0.25)])), BLACK)  # (2, 1, 0.5) in the input
    for shown, own in ((red, placement(3.0)), (green, placement(1.0, angle=1.0))):
        pose = torch.eye(4)[None, :3].double()
        pose[0, :, 3] = torch.tensor([2.0, 1.0, 0.5])
        torch.testing.assert_close(shown.views[-1].camera.camera_to_worlds, own.poses(pose).float())


class White(Shown):
    """Its settings ask for a white background, though its images have no alpha."""

    @property
    def background(self) -> torch.Tensor:
        return torch.ones(3)


def test_the_background_is_that_of_the_runs() -> None:
    whole = composed([block((0.0, 0.0, 0.0), 5.0)], [White(torch.zeros(3, 4))], [placement(1.0)], placement(1.0))
    assert whole.background.tolist() == [1.0, 1.0, 1.0]


def test_a_block_sees_the_camera_where_its_refined_poses_lead() -> None:
    shown = Drifted(torch.zeros(3, 4))
    model = composed([block((0.0, 0.0, 0.0), 5.0)], [shown], [placement(3.0)], placement(0.5))
    model.render_view(View(cameras([(0.5, 0.0, 0.0)])), BLACK)  # (1, 0, 0) in the input
    torch.testing.assert_close(shown.views[-1].camera.camera_to_worlds[0, :, 3], torch.tensor([3.5, 0.0, 0.0]))


def test_what_is_far_is_not_opened() -> None:
    blocks = [block((10.0 * number, 0.0, 0.0), 8.0) for number in range(50)]
    asked: list[int] = []

    def load(number: int) -> Opened:
        asked.append(number)
        return Opened(plain(0.5, 0.5, 0.5), placement(1.0))

    model = Blocks(blocks, few_in_memory(load, 2), placement(1.0), scene())
    model.render_view(View(cameras([(204.0, 0.0, 0.0)])), BLACK)
    assert sorted(set(asked)) == [0, 20, 21]  # the first tells the shared facts
    assert len(asked) == 3


def test_the_one_that_was_not_used_for_longest_leaves_memory() -> None:
    """It leaves before another is loaded, so that there is never one more."""
    held: dict[int, weakref.ref[Shown]] = {}
    loads: list[int] = []

    def load(number: int) -> Opened:
        gc.collect()
        assert sum(one() is not None for one in held.values()) < 2
        shown = plain(0.1, 0.2, 0.3)
        held[number] = weakref.ref(shown)
        loads.append(number)
        return Opened(shown, placement(1.0))

    opened = few_in_memory(load, 2)
    for number in (0, 1, 0, 2, 0, 1):
        opened(number)
    gc.collect()
    assert loads == [0, 1, 2, 1]
    assert [number for number, one in held.items() if one() is not None] == [0, 1]


def test_what_shows_nothing_of_the_view_has_no_share() -> None:
    models = plain(1.0, 0.0, 0.0, opacity=1.0), plain(0.0, 1.0, 0.0, opacity=0.0)
    blocks = [block((0.0, 0.0, 0.0), 5.0), block((4.0, 0.0, 0.0), 5.0)]
    model = composed(blocks, models, (placement(1.0), placement(1.0)), placement(1.0))
    picture = model.render_view(View(cameras([(2.5, 0.0, 0.0)])), torch.ones(3))
    torch.testing.assert_close(picture.rgb[0, 0], torch.tensor([1.0, 0.0, 0.0]))
    assert [len(shown.views) for shown in models] == [2, 1]  # a look at both, and a picture of one


def test_a_flight_across_a_seam_has_no_step() -> None:
    models = plain(1.0, 0.0, 0.0), plain(0.0, 1.0, 0.0)
    blocks = [block((0.0, 0.0, 0.0), 4.0), block((4.0, 0.0, 0.0), 4.0)]
    model = composed(blocks, models, (placement(1.0), placement(2.0)), placement(1.0))
    colors = [
        model.render_view(View(cameras([(0.02 * step, 0.0, 0.0)]), stride=12), BLACK).rgb[0, 0] for step in range(200)
    ]
    steps = (torch.stack(colors)[1:] - torch.stack(colors)[:-1]).abs().max()
    assert float(steps) < 0.06


def test_similarities_between_scenes_are_exact_far_from_the_origin() -> None:
    """Two scenes 5,000 km from the input's origin, as in UTM; their coordinates are small."""
    place = torch.tensor([4.5e5, 5.2e6, 300.0], dtype=torch.float64)
    one, other = (placement(0.01, angle=0.3).about(-place), placement(0.2, (3.0, 1.0, 0.0), 0.3).about(-place))
    points = torch.randn(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rotation, scale, shift = one.similarity_to(other)
    torch.testing.assert_close(rotation, torch.eye(3, dtype=torch.float64))
    assert scale == pytest.approx(20)
    found = scale * points @ rotation.T + shift
    torch.testing.assert_close(found, other.points(one.original_points(points)), atol=1e-6, rtol=0)


@pytest.mark.parametrize("model", ["pinhole", "orthographic"])
def test_a_moved_camera_sees_moved_points_at_the_same_pixels(model: str) -> None:
    camera = cameras([(0.3, -0.2, 0.5)], model).in_float64()
    points = torch.rand(30, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - torch.tensor(
        [0.0, 0.0, 4.0]
    )
    rotation, scale, shift = placement(1.0).similarity_to(placement(2.5, (0.3, 0.1, -0.4), 0.7))
    before = camera.project(points, 0)
    after = moved_cameras(camera, rotation, scale, shift).project(scale * points @ rotation.T + shift, 0)
    torch.testing.assert_close(after[0], before[0])
    torch.testing.assert_close(after[1], before[1])


def test_blocks_that_learned_in_other_light_are_matched() -> None:
    """The second block learned in other light; matched by shared images, it looks as the first."""
    true = torch.tensor([[0.6, 0.1, 0.0, 0.2], [0.0, 0.5, 0.2, 0.1], [0.3, 0.0, 0.4, 0.3]])
    gain = torch.tensor([[1.3, 0.0, 0.0], [0.0, 0.8, 0.0], [0.1, 0.0, 1.1]])
    models = Shown(true), Shown(gain @ true + torch.tensor([0.05, 0.0, 0.02])[:, None] * torch.tensor([0.0, 0, 0, 1]))
    blocks = [block((0.0, 0.0, 0.0), 5.0, (0, 1, 2)), block((4.0, 0.0, 0.0), 5.0, (1, 2, 3))]
    model = composed(blocks, models, (placement(1.0), placement(1.0)), placement(1.0))
    photographs = cameras([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (3.0, 0.0, 0.0), (4.0, 0.0, 0.0)])
    found = matched(model, photographs, None)
    assert [one.cameras for one in found] == [one.cameras for one in blocks]
    again = composed(found, models, (placement(1.0), placement(1.0)), placement(1.0))
    first, second = (again.render_view(View(photographs[i : i + 1]), BLACK).rgb for i in (0, 3))
    before = model.render_view(View(photographs[3:4]), BLACK).rgb
    assert float((first - before).abs().mean()) > 0.05
    assert float((first - second).abs().mean()) < 0.02

"""Where rays start: at the first place that several training images show."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from nerfloom.cameras.cameras import Cameras
from nerfloom.data.dataset import Dataset
from nerfloom.data.sparse_depth import SparseDepth
from nerfloom.geometry.bounds import nested_boxes
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.march.first_covisible import CELLS, LEVELS, REACH, STEPS, first_covisible_reference
from nerfloom.methods.nerfacto import METHOD
from nerfloom.ray_model import RayModel
from nerfloom.registry import load_dataparser, load_method
from nerfloom.scene.covisible_space import CovisibleSpace, share_cut_off, times_seen
from nerfloom.training.data_folder import find_data
from nerfloom.training.preparation import decided
from nerfloom.training.ray_starts import MAX_LATE, NOTHING_TO_TEST, share_late
from tests.test_free_space import row
from tests.training.test_graphs import small

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
CELL, STEP = 2 / CELLS, REACH / (STEPS - 1)


def fan(*slopes: float, near: float = 0.05, far: float = 100.0) -> Rays:
    """Rays from the origin in the plane y = 0, by their slopes x / -z."""
    slope = torch.tensor(slopes)
    directions = torch.stack([slope, 0 * slope, 0 * slope - 1], -1)
    directions = directions / directions.norm(dim=-1, keepdim=True)
    ends = torch.ones(len(slopes))
    return Rays(torch.zeros(len(slopes), 3), directions, near * ends, far * ends)


def shared(cameras: Cameras, least: int, nearest: float = 0.0) -> CovisibleSpace:
    found = CovisibleSpace(BOX)
    found.exclude(cameras, torch.full((len(cameras),), nearest), least)
    return found


def test_a_ray_starts_where_a_second_camera_sees_it() -> None:
    """The camera at x = 0.5 sees |x - 0.5| < -z: of a ray with slope a, all from the depth 0.5 / (1 + a) on."""
    slopes = torch.tensor([-0.5, -0.2, 0.0, 0.3, 0.8])
    rays = fan(*slopes.tolist())
    starts = shared(row(0.0, 0.5), 2)(rays).nears
    expected = 0.5 / (1 + slopes) * (1 + slopes**2).sqrt()
    assert bool((starts > expected - CELL).all())
    assert bool((starts < 1.3 * expected + 3 * CELL).all())  # cells count as seen when all of them is


def test_a_ray_starts_beyond_what_images_are_known_to_show_nothing_before() -> None:
    rays = fan(-0.3, 0.0, 0.3)
    starts = shared(row(0.0, 0.0), 2, nearest=0.7)(rays).nears
    assert bool(((starts > 0.7 - CELL) & (starts < 0.7 + CELL + STEP)).all())


@pytest.mark.parametrize("least", [1, 2, 3])
def test_a_ray_stays_as_it_is_where_that_many_see_it_from_the_start_or_none_ever_does(least: int) -> None:
    together = shared(row(0.0, 0.0, 0.0), least)
    rays = fan(-0.5, 0.0, 0.5, near=0.4)
    assert torch.equal(together(rays).nears, rays.nears)
    turned = row(0.0, 0.0)
    turned.camera_to_worlds[1, :, 0] *= -1
    turned.camera_to_worlds[1, :, 2] *= -1
    rays = dataclasses.replace(rays, fars=torch.full((3,), 1.5))
    assert torch.equal(shared(turned, least)(rays).nears, rays.nears)


def test_a_single_camera_shares_with_itself() -> None:
    rays = fan(0.0, 0.4, near=0.4)
    assert torch.equal(shared(row(0.0), 2)(rays).nears, rays.nears)


def test_nothing_is_left_out_before_the_cameras_are_known_and_none_beyond_the_boxes() -> None:
    rays = fan(0.0, 0.4)
    assert torch.equal(CovisibleSpace(BOX)(rays).nears, rays.nears)
    outside = dataclasses.replace(rays, origins=rays.origins + torch.tensor([0.0, 50.0, 0.0]))
    assert torch.equal(shared(row(0.0, 9.0), 2)(outside).nears, rays.nears)
    assert len(CovisibleSpace(BOX)(fan()).nears) == 0


def test_cells_are_counted_whose_points_are_all_seen() -> None:
    """Random points of each box, projected in float64: points in a cell that k images show are on k images at least."""
    cameras = row(0.0, 0.4, -0.7)
    generator = torch.Generator().manual_seed(0)
    shown = missed = 0
    for box in nested_boxes(BOX, LEVELS):
        counts = times_seen(cameras, torch.zeros(3), box, CELLS, 3)
        points = box[0].double() + torch.rand(20_000, 3, generator=generator, dtype=torch.float64) * (box[1] - box[0])
        x, y, z = ((points - box[0]) / (box[1] - box[0]) * CELLS).long().unbind(-1)
        found = counts[(x * CELLS + y) * CELLS + z].long()
        across = points[:, 0, None] - cameras.camera_to_worlds[:, 0, 3].double()
        down, depth = points[:, 1, None], -points[:, 2, None]
        exact = ((depth > 0) & (across.abs() < depth) & (down.abs() < depth)).sum(-1)
        assert bool((found <= exact).all())
        shown, missed = shown + int(exact.sum()), missed + int((exact - found).sum())
    assert missed < 0.3 * shown  # those at the edges of the images


def test_starts_are_those_of_float64() -> None:
    found, rays = shared(row(0.0, 0.5), 2), fan(-0.5, -0.2, 0.0, 0.3, 0.8)
    exact = Rays(*(each.double() for each in (rays.origins, rays.directions, rays.nears, rays.fars)))
    expected = first_covisible_reference(exact, found.box.double(), found.excluded)
    torch.testing.assert_close(found(rays).nears.double(), expected, rtol=1e-5, atol=1e-6)
    assert bool((expected > exact.nears).all())


def test_training_leaves_out_what_one_image_shows_and_says_so(tmp_path: Path) -> None:
    trainer = small(tmp_path, rays_shared_by=2)
    trainer.prepare()
    space, dataset = trainer.model.covisible_space, trainer.train_set
    assert isinstance(space, CovisibleSpace)
    expected = CovisibleSpace(dataset.scene.box)
    expected.exclude(dataset.cameras, torch.full_like(dataset.cameras.fx, dataset.scene.near), 2)
    assert torch.equal(space.excluded, expected.excluded)
    assert 0 < int(space.excluded.sum()) < len(space.excluded)
    assert "covisible_space.excluded" in trainer.model.state_dict()  # which checkpoints keep
    assert [d.choice for d in trainer.profile.decisions if d.option == "rays start"] == [
        "where at least 2 photographs look"
    ]


def with_points(dataset: Dataset, distance: float) -> Dataset:
    """The images; every 50th pixel is known to show something at that distance."""
    pixels = torch.arange(0, dataset.cameras.ends[-1], 50)
    known = SparseDepth(pixels, torch.full((len(pixels),), distance), torch.full((len(pixels),), 0.01))
    scene = dataclasses.replace(dataset.scene, num_sparse_depths=len(pixels))
    return dataclasses.replace(dataset, sparse_depth=known, scene=scene)


def around(distance: float, *degrees: float) -> Cameras:
    """Cameras at a distance from the origin, in the plane y = 0, that look at it with 90 degrees from edge to edge."""
    cameras = row(*[0.0] * len(degrees))
    angles = torch.deg2rad(torch.tensor(degrees))
    sine, cosine = angles.sin(), angles.cos()
    turned = torch.zeros(len(degrees), 3, 4)
    turned[:, 0, 0], turned[:, 0, 2], turned[:, 1, 1], turned[:, 2, 0], turned[:, 2, 2] = cosine, sine, 1, -sine, cosine
    turned[:, :, 3] = distance * turned[:, :, 2]
    return dataclasses.replace(cameras, camera_to_worlds=turned)


def seen_by(dataset: Dataset, cameras: Cameras) -> Dataset:
    """The data set without points, as if its images had been taken by the cameras."""
    many = len(dataset.cameras)
    return dataclasses.replace(dataset, sparse_depth=None, cameras=cameras[torch.arange(many) % len(cameras)])


@pytest.mark.parametrize(
    ("cameras", "reason"),
    [
        (around(1.0, *range(0, 360, 30)), None),
        (around(0.2, -20, 0, 20), "% of the rays"),  # at 0.2, cells of 1/16 and their balls reach up to the target
        (around(-1.0, *range(0, 360, 30)), "look apart"),
    ],
)
def test_without_points_what_cameras_look_at_decides_whether_rays_start_late(
    cameras: Cameras, reason: str | None, tmp_path: Path
) -> None:
    trainer = small(tmp_path)
    dataset = seen_by(trainer.train_set, cameras)
    config = dataclasses.replace(trainer.config, rays_shared_by="auto")
    _, settings, made = decided(METHOD, config, dataset)
    assert settings.rays_shared_by == (2 if reason is None else 0)
    said = [decision.line() for decision in made if decision.option == "rays start"]
    assert len(said) == (reason is not None)
    assert all("at their near ends" in line and str(reason) in line for line in said)


@pytest.mark.parametrize("changed", [{"moving": True}, {"num_scenes": 2}])
def test_without_points_scenes_that_move_and_several_start_at_the_near_ends(
    changed: dict[str, Any], tmp_path: Path
) -> None:
    trainer = small(tmp_path)
    still = seen_by(trainer.train_set, around(1.0, *range(0, 360, 30)))
    other = dataclasses.replace(still, scene=dataclasses.replace(still.scene, **changed))
    config = dataclasses.replace(trainer.config, rays_shared_by="auto")
    _, settings, made = decided(METHOD, config, other)
    assert settings.rays_shared_by == 0
    assert [decision for decision in made if decision.option == "rays start" and NOTHING_TO_TEST in decision.line()]


def test_the_share_of_rays_that_start_late_is_that_of_the_geometry() -> None:
    """Two cameras at the distance 1 look at the origin from +-40 degrees.

    Rays start late if they are nowhere before 0.8 in both images. There are more, because a cell counts as seen where
    all of its ball is seen; but fewer than the rays that are nowhere before 0.9 by a cell's diagonal within both.
    """
    cameras, space = around(1.0, -40, 40), CovisibleSpace(BOX / 4)
    cameras = dataclasses.replace(cameras, fx=4 * cameras.fx, fy=4 * cameras.fy)
    space.exclude(cameras, torch.zeros(2), 2)
    late = share_late(space, cameras, 0.01, 100.0)
    rays = cameras.pixel_rays(torch.arange(int(cameras.offsets[-1])), 0.01, 100.0)

    def nowhere(end: float, margin: float) -> float:
        points = rays.origins + torch.linspace(0.01, end, 400)[:, None, None] * rays.directions
        within = torch.ones(points.shape[:2], dtype=torch.bool)
        for pose in cameras.camera_to_worlds:
            x, y, z = ((points - pose[:, 3]) @ pose[:, :3]).unbind(-1)
            within &= (-z / 4 - torch.maximum(x.abs(), y.abs())) / math.hypot(1, 1 / 4) > margin
        return float((~within.any(0)).double().mean())

    least, most = nowhere(0.8, 0.0), nowhere(0.9, CELL / 2 * math.sqrt(3))
    print(f"{least:.3f} <= {late:.3f} <= {most:.3f}")
    assert late is not None
    assert 0 < least <= late <= most < 0.5


@pytest.mark.medium
@pytest.mark.parametrize(
    ("capture", "on"),
    [("fern", False), ("colmap_desk", False), ("snowmiku", True), ("fox", True), ("statue_of_liberty", True)],
)
def test_in_real_captures_rays_start_late_where_the_cameras_go_around_something(
    real_data: Path, capture: str, on: bool
) -> None:
    path, name = find_data(real_data / capture, None)
    parsed = load_dataparser(name)().parse(path, "train")
    space = CovisibleSpace(parsed.box)
    space.exclude(parsed.cameras, torch.full_like(parsed.cameras.fx, parsed.near), 2)
    late = share_late(space, parsed.cameras, parsed.near, parsed.far)
    assert late is not None
    print(f"{capture}: {100 * late:.2f} % start late")
    assert (late <= MAX_LATE) == on


@pytest.mark.parametrize(("distance", "least"), [(50.0, 2), (0.06, 0)])
def test_known_points_decide_whether_rays_start_late(distance: float, least: int, tmp_path: Path) -> None:
    trainer = small(tmp_path)
    dataset = with_points(trainer.train_set, distance)
    config = dataclasses.replace(trainer.config, rays_shared_by="auto")
    _, settings, made = decided(METHOD, config, dataset)
    assert settings.rays_shared_by == least
    said = [decision.line() for decision in made if decision.option == "rays start"]
    assert len(said) == (not least)
    assert all("at their near ends" in line and "% of the points" in line for line in said)
    for chosen in (0, 2):  # an explicit choice is kept
        asked = dataclasses.replace(config, rays_shared_by=chosen)
        assert decided(METHOD, asked, dataset)[1].rays_shared_by == chosen


@pytest.mark.parametrize(
    ("name", "asked"), [("neus", {}), ("volsdf", {}), ("nerf-plus-plus", {"encoding": "hash-grid"})]
)
@pytest.mark.parametrize(("distance", "least"), [(50.0, 2), (0.06, 0)])
def test_starts_before_a_sphere_are_checked_too(
    name: str, asked: dict[str, Any], distance: float, least: int, tmp_path: Path
) -> None:
    """One grid marches the inside, and has no boxes around it: its rays start late, if this cuts nothing off."""
    method, dataset = load_method(name), with_points(small(tmp_path).train_set, distance)
    config = dataclasses.replace(method.config, log2_table_size=12, **asked)  # type: ignore[call-arg]
    _, settings, _ = decided(method, config, dataset)
    assert (settings.background_model, settings.sampler) == ("sphere", "occupancy")  # type: ignore[attr-defined]
    assert settings.rays_shared_by == least
    model = method.build(settings, dataset.scene)
    assert isinstance(model, RayModel)
    assert (model.covisible_space is not None) == bool(least)
    if model.covisible_space is not None:  # cells of the box that the check looks at
        assert torch.equal(model.covisible_space.box, dataset.scene.box)


def test_the_share_of_what_is_cut_off() -> None:
    """Rays of the slopes 0 and 0.8 start behind 0.5 and 0.28, as in the first test."""
    space, rays = shared(row(0.0, 0.5), 2), fan(0.0, 0.8)
    assert share_cut_off(space, rays, torch.tensor([5.0, 5.0])) == 0
    assert share_cut_off(space, rays, torch.tensor([0.4, 5.0])) == 0.5
    assert share_cut_off(space, rays, torch.tensor([0.4, 0.2])) == 1


@pytest.mark.parametrize("settings", [{"rays_shared_by": 0}, {"sampler": "occupancy"}])
def test_rays_start_at_the_near_end_where_one_says_so_and_in_nested_boxes(
    settings: dict[str, Any], tmp_path: Path
) -> None:
    trainer = small(tmp_path, **settings)
    trainer.prepare()
    assert trainer.model.covisible_space is None
    assert not [d for d in trainer.profile.decisions if d.option == "rays start"]

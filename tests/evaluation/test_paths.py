"""Camera paths: against geometry worked out by hand."""

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from scipy.special import ive
from torch import Tensor

from nerfloom import Picture, View
from nerfloom.cameras.cameras import Cameras, check_pose
from nerfloom.cameras.ndc import Ndc, NdcCameras
from nerfloom.cameras.poses import looked_at
from nerfloom.evaluation.paths import (
    Arc,
    Walk,
    arc_of,
    focus_distance,
    fractions,
    interpolate,
    look_at,
    look_same_way,
    middle_pose,
    orbit,
    replace_poses,
    shortest_order,
    spiral,
    walk_of,
)

UP = torch.tensor([0.0, 0.0, 1.0])


def test_look_at_from_the_x_axis() -> None:
    pose = look_at(torch.tensor([3.0, 0, 0]), torch.zeros(3), UP)
    # Looking along -x: the camera's z is world x, its y is world z, so its x is y cross z = world y.
    expected = torch.tensor([[0.0, 0, 1, 3], [1, 0, 0, 0], [0, 1, 0, 0]])
    torch.testing.assert_close(pose, expected)
    torch.testing.assert_close(look_at([3, 0, 0], [0, 0, 0]), expected)  # numbers will do, and z is up


@pytest.mark.parametrize("position", [(0.0, 0.0, 2.0), (0.0, 0.0, -2.0), (1.0, 2.0, 3.0)])
def test_look_at_is_rigid_even_along_the_vertical(position: tuple[float, float, float]) -> None:
    pose = look_at(torch.tensor(position), torch.zeros(3), UP)
    check_pose(pose, "look_at")
    ahead = -pose[:, 2]
    torch.testing.assert_close(ahead, -torch.tensor(position) / torch.tensor(position).norm())


def test_orbit_keeps_height_and_distance_and_looks_at_the_centre() -> None:
    poses = torch.eye(4)[:3].repeat(2, 1, 1)
    poses[0, :, 3] = torch.tensor([3.0, 0, 1])
    poses[1, :, 3] = torch.tensor([0.0, 5, 3])
    ones = torch.ones(2)
    cameras = Cameras(poses, ones, ones, ones, ones, ones.long(), ones.long())
    path = orbit(cameras, torch.zeros(3), fractions(8))
    centers = path.camera_to_worlds[:, :, 3]
    torch.testing.assert_close(centers[:, 2], torch.full((8,), 2.0))
    torch.testing.assert_close(centers[:, :2].norm(dim=-1), torch.full((8,), 4.0))
    ahead = -path.camera_to_worlds[:, :, 2]
    torch.testing.assert_close(torch.linalg.cross(ahead, centers), torch.zeros(8, 3), atol=1e-5, rtol=0)
    for pose in path.camera_to_worlds:
        check_pose(pose, "orbit")
    # Half as far away, at the same elevation.
    near = orbit(cameras, torch.zeros(3), fractions(8), radius=2.0).camera_to_worlds
    torch.testing.assert_close(near[:, :, 3], centers / 2)
    torch.testing.assert_close(near[:, :, :3], path.camera_to_worlds[:, :, :3])


def test_an_orbit_that_follows_is_as_high_and_as_far_as_the_cameras_there() -> None:
    """The mean of a cosine under a von Mises distribution is the cosine times I1(k) / I0(k), here with k = 1 / s^2."""
    azimuths = torch.arange(360, dtype=torch.float64).deg2rad()
    elevations, distances = 0.7 + 0.4 * azimuths.cos(), 3 - azimuths.sin()
    away, heights = distances * elevations.cos(), distances * elevations.sin()
    poses = torch.eye(4)[:3].repeat(360, 1, 1)
    poses[:, :, 3] = torch.stack([away * azimuths.cos(), away * azimuths.sin(), heights], -1).float() + CENTER
    ones = torch.ones(360)
    cameras = Cameras(poses, ones, ones, ones, ones, ones.long(), ones.long())
    path = orbit(cameras, CENTER, fractions(36), follow=True).camera_to_worlds
    offsets = (path[:, :, 3] - CENTER).double()
    at, sharpness = torch.atan2(offsets[:, 1], offsets[:, 0]), 1 / math.radians(20) ** 2
    flatter = float(ive(1, sharpness) / ive(0, sharpness))
    assert flatter > 0.9
    found = offsets.norm(dim=-1)
    torch.testing.assert_close(found, 3 - flatter * at.sin(), atol=1e-5, rtol=0)
    torch.testing.assert_close((offsets[:, 2] / found).asin(), 0.7 + 0.4 * flatter * at.cos(), atol=1e-5, rtol=0)
    for pose in path:
        check_pose(pose, "orbit")
    half = orbit(cameras, CENTER, fractions(36), radius=float(away.mean()) / 2, follow=True).camera_to_worlds
    torch.testing.assert_close((half[:, :, 3] - CENTER).double(), offsets / 2, atol=1e-5, rtol=0)


def test_an_orbit_above_a_gap_is_as_high_as_the_cameras_behind_it() -> None:
    """Low cameras in front and high ones behind, at the same place each: the path does not sink behind."""
    low, high = standing(torch.arange(-100, 101, 5)), standing(torch.arange(110, 251, 20), radius=1.0)
    high.camera_to_worlds[:, 2, 3] = 3.0
    cameras = replace_poses(low, torch.cat([low.camera_to_worlds, high.camera_to_worlds]))
    assert arc_of(cameras, CENTER) is None
    offsets = orbit(cameras, CENTER, fractions(8), follow=True).camera_to_worlds[:, :, 3] - CENTER
    torch.testing.assert_close(offsets[0], torch.tensor([2.0, 0, 1]), atol=1e-3, rtol=0)
    torch.testing.assert_close(offsets[4], torch.tensor([-1.0, 0, 3]), atol=0.05, rtol=0)


def test_an_orbit_that_follows_cameras_above_is_a_circle() -> None:
    cameras = standing(torch.tensor([10]), radius=0.0)
    assert float(orbit(cameras, CENTER, fractions(4), follow=True).camera_to_worlds[:, 2, 3].min()) == 1


def test_frames_are_even_or_ease_in_and_out() -> None:
    assert fractions(4).tolist() == [0, 0.25, 0.5, 0.75]  # the first frame follows the last
    assert fractions(5, closed=False).tolist() == [0, 0.25, 0.5, 0.75, 1]
    assert fractions(1, closed=False).tolist() == [0]
    eased = fractions(5, closed=False, ease=True)
    assert eased.tolist() == [0, 0.15625, 0.5, 0.84375, 1]  # 3 u^2 - 2 u^3
    fine = fractions(1001, closed=False, ease=True)
    shares = torch.linspace(0, 1, 1001, dtype=torch.float64)
    speed = fine.diff() * 1000
    torch.testing.assert_close(speed, 6 * (shares * (1 - shares))[:-1], atol=0.01, rtol=0)


def standing(degrees: Tensor, radius: float = 2.0, center: tuple[float, float] = (0.3, -0.2)) -> Cameras:
    """Return cameras at angles (M,) on a circle around a vertical axis, in any order."""
    angles = torch.deg2rad(degrees.float())
    poses = torch.eye(4)[:3].repeat(len(angles), 1, 1)
    poses[:, 0, 3], poses[:, 1, 3] = center[0] + radius * angles.cos(), center[1] + radius * angles.sin()
    poses[:, 2, 3] = 1.0
    ones = torch.ones(len(angles))
    return Cameras(poses, ones, ones, ones, ones, ones.long(), ones.long())


CENTER = torch.tensor([0.3, -0.2, 0.0])


@pytest.mark.parametrize("first", [-170, -45, 10, 130])
@pytest.mark.parametrize("width", [40, 200, 290])
def test_the_arc_on_which_cameras_stand(first: int, width: int) -> None:
    degrees = first + torch.linspace(0, width, 30)
    arc = arc_of(standing(degrees[torch.randperm(30, generator=torch.Generator().manual_seed(width))]), CENTER)
    assert arc is not None
    assert math.degrees(arc.width) == pytest.approx(width, abs=1e-3)
    apart = math.degrees(arc.middle) - (first + width / 2)
    assert math.remainder(apart, 360) == pytest.approx(0, abs=1e-3)


def test_cameras_all_around_have_no_arc_and_few_have_none_either() -> None:
    assert arc_of(standing(torch.arange(0, 360, 50)), CENTER) is None
    assert arc_of(standing(torch.tensor([10, 20])), CENTER) is None
    assert arc_of(standing(torch.arange(0, 300, 10)), CENTER) is not None


def test_cameras_above_the_centre_do_not_close_a_gap() -> None:
    around, above = standing(torch.arange(0, 181, 10)), standing(torch.arange(185, 360, 10), radius=0.1)
    poses = torch.cat([around.camera_to_worlds, above.camera_to_worlds])
    arc = arc_of(replace_poses(around, poses), CENTER)
    assert arc is not None
    assert math.degrees(arc.width) == pytest.approx(180, abs=1e-3)


def test_an_orbit_swings_over_its_arc_and_ends_where_it_begins() -> None:
    cameras = standing(torch.linspace(100, 260, 20))
    path = orbit(cameras, CENTER, fractions(48), arc_of(cameras, CENTER))
    offsets = path.camera_to_worlds[:, :, 3] - CENTER
    degrees = torch.rad2deg(torch.atan2(offsets[:, 1], offsets[:, 0])) % 360
    assert float(degrees.min()) == pytest.approx(100, abs=0.01)
    assert float(degrees.max()) == pytest.approx(260, abs=0.01)
    turns = torch.cat([degrees, degrees[:1]]).diff()
    assert float(turns.sum()) == pytest.approx(0, abs=1e-3)
    assert float(turns.abs().max()) < 80 * 2 * math.pi / 48 + 0.1  # no jump, as a film of it runs on and on
    torch.testing.assert_close(offsets[:, :2].norm(dim=-1), torch.full((48,), 2.0))
    still = orbit(cameras, CENTER, fractions(48), Arc(middle=0.5, width=0.0)).camera_to_worlds
    assert torch.equal(still, still[:1].expand(48, 3, 4))


def test_other_poses_keep_the_lens() -> None:
    ones, lens = torch.ones(2), torch.tensor([[0.1, 0.2, 0.3, 0.4], [0, 0, 0, 0]])
    cameras = Cameras(
        torch.eye(4)[:3].repeat(2, 1, 1), ones, ones, ones, ones, ones.long(), ones.long(), "fisheye", lens
    )
    path = replace_poses(cameras, torch.eye(4)[:3].repeat(5, 1, 1))
    assert path.model == "fisheye"
    assert path.lens is not None
    torch.testing.assert_close(path.lens, lens[:1].repeat(5, 1))


def test_an_interpolated_path_is_a_walk_without_the_shaking() -> None:
    """Cameras that turn about z along a circle, each shaken: the path is rigid, near, steadier, and ends as they do."""
    draws = torch.Generator().manual_seed(0)
    angles = torch.linspace(0, 3, 72) + 0.02 * torch.randn(72, generator=draws)
    zero, one = torch.zeros(72), torch.ones(72)
    rotations = torch.stack([angles.cos(), -angles.sin(), zero, angles.sin(), angles.cos(), zero, zero, zero, one], -1)
    centres = torch.stack([4 * angles.cos(), 4 * angles.sin(), zero], dim=-1)
    poses = torch.cat([rotations.view(72, 3, 3), centres[..., None]], dim=-1)
    cameras = Cameras(poses, one, one, one, one, one.long(), one.long())
    path = interpolate(cameras, fractions(72, closed=False), walk_of(cameras)).camera_to_worlds
    for pose in path:
        check_pose(pose, "path")
    found = torch.atan2(path[:, 1, 0], path[:, 0, 0])
    assert (found - torch.linspace(float(angles[0]), float(angles[-1]), 72)).abs().max() < 0.03
    assert found.diff().std() < 0.25 * angles.diff().std()
    assert (path[:, :, 3].norm(dim=-1) - 4).abs().max() < 0.1
    torch.testing.assert_close(path[[0, -1]], poses[[0, -1]], atol=1e-3, rtol=0)


def test_a_path_past_one_camera_stands_still() -> None:
    one = torch.ones(1)
    cameras = Cameras(torch.eye(4)[None, :3], one, one, one, one, one.long(), one.long())
    for closed in (False, True):
        found = interpolate(cameras, fractions(3, closed), walk_of(cameras, closed)).camera_to_worlds
        torch.testing.assert_close(found, torch.eye(4)[:3].repeat(3, 1, 1))


def grid_of_cameras() -> Cameras:
    """Nine cameras on a grid in a plane, all looking along -z."""
    x, y = torch.meshgrid(torch.linspace(-1, 1, 3), torch.linspace(-2, 2, 3), indexing="ij")
    positions = torch.stack([x, y, torch.zeros(3, 3)], -1).view(9, 3) + torch.tensor([5.0, 6.0, 7.0])
    poses = torch.cat([torch.eye(3).expand(9, 3, 3), positions[..., None]], dim=-1)
    ones = torch.ones(9)
    return Cameras(poses, ones, ones, ones, ones, ones.long(), ones.long())


def test_a_spiral_turns_around_the_mean_camera_and_looks_at_one_point() -> None:
    path = spiral(grid_of_cameras(), fractions(16), focus=4.0, radius=0.5).camera_to_worlds
    middle = torch.tensor([5.0, 6.0, 7.0])
    angles = torch.arange(16) * 2 * math.pi * 2 / 16  # two turns, and half of one back and forth
    expected = middle + 0.5 * torch.stack([angles.cos(), -angles.sin(), -(angles / 2).sin()], dim=-1)
    torch.testing.assert_close(path[:, :, 3], expected)
    towards = middle - torch.tensor([0.0, 0.0, 4.0]) - path[:, :, 3]
    torch.testing.assert_close(-path[:, :, 2], towards / towards.norm(dim=-1, keepdim=True))
    for pose in path:
        check_pose(pose, "spiral")


def test_the_radius_of_a_spiral_is_the_spread_of_the_cameras() -> None:
    centers = spiral(grid_of_cameras(), fractions(400), focus=4.0).camera_to_worlds[:, :, 3]
    # The 90th percentile of |x| in {0, 1} and of |y| in {0, 2}, each three and six times; z does not vary.
    path = centers - torch.tensor([5.0, 6.0, 7.0])
    torch.testing.assert_close(path.abs().amax(0), torch.tensor([1.0, 2.0, 0.0]), atol=1e-3, rtol=0)


def test_around_an_object_a_spiral_starts_from_the_first_camera() -> None:
    turn = torch.tensor([[-1.0, 0, 0], [0, 1, 0], [0, 0, -1]])
    poses = torch.eye(4)[:3].repeat(2, 1, 1)
    poses[1, :, :3] = turn
    poses[0, :, 3] = torch.tensor([0.0, 0, 3])
    ones = torch.ones(2)
    cameras = Cameras(poses, ones, ones, ones, ones, ones.long(), ones.long())
    assert not look_same_way(cameras)
    assert torch.equal(middle_pose(cameras), poses[0])
    offsets = spiral(cameras, fractions(8), focus=3.0).camera_to_worlds[:, :, 3] - poses[0, :, 3]
    torch.testing.assert_close(offsets[:, :2].norm(dim=-1), torch.full((8,), 0.3))


@pytest.mark.parametrize("warped", [False, True])
def test_the_distance_of_what_is_seen(warped: bool) -> None:
    """A wall at depth 5 before a narrow camera, in the scene's coordinates and in normalised device coordinates."""
    numbers = [torch.tensor([value]) for value in (4000.0, 4000.0, 16.0, 16.0)]
    size = torch.tensor([32])
    pose = torch.eye(4)[None, :3]
    ndc = Ndc(tuple(map(tuple, torch.eye(4)[:3].tolist())), near=2.0, half_width=0.004, half_height=0.004)
    camera = NdcCameras(pose, *numbers, size, size, ndc=ndc) if warped else Cameras(pose, *numbers, size, size)

    def render_view(view: View, background: Tensor) -> Picture:
        rays = view.camera.pixel_rays(view.pixels().flatten(), 0.0, 100.0)
        # Appendix C of NeRF: depth z becomes 1 + 2 near / z, with z = -5 here.
        wall = 1 - 2 * 2.0 / 5 if warped else -5.0
        depth = ((wall - rays.origins[:, 2]) / rays.directions[:, 2]).view(view.height, view.width)
        return Picture(torch.zeros(view.height, view.width, 3), depth, depth, torch.ones_like(depth))

    model: Any = SimpleNamespace(render_view=render_view, scene=SimpleNamespace(moving=False, near=0.1))
    assert focus_distance(model, camera, torch.zeros(3)) == pytest.approx(5.0, rel=1e-3)


def along(places: list[float]) -> Cameras:
    """Cameras at these places of the x axis, which look along -z."""
    poses = torch.eye(4)[:3].repeat(len(places), 1, 1)
    poses[:, 0, 3] = torch.tensor(places)
    ones = torch.ones(len(places))
    return Cameras(poses, ones, ones, ones, ones, ones.long(), ones.long())


def parts_of(walk: Walk) -> list[list[int]]:
    return [part.tolist() for part in walk.stretches]


def test_a_path_does_not_fly_from_one_stretch_of_a_walk_to_the_next() -> None:
    near, far = [float(place) for place in range(10)], [50.0 + place for place in range(10)]
    cameras = along(near + far)
    places = interpolate(cameras, fractions(100, closed=False), walk_of(cameras)).camera_to_worlds[:, 0, 3]
    assert bool(((places < 9.01) | (places > 49.99)).all())
    assert float(places[0]) == pytest.approx(0, abs=1)
    assert float(places[-1]) == pytest.approx(59, abs=1)
    assert bool((places.diff() >= 0).all())


def test_what_stands_alone_between_two_jumps_is_not_passed() -> None:
    near, far = [float(place) for place in range(5)], [50.0 + place for place in range(5)]
    assert parts_of(walk_of(along([*near, 30.0, *far]))) == [[0, 1, 2, 3, 4], [6, 7, 8, 9, 10]]


@pytest.mark.parametrize("places", [[0.0], [0.0, 7.0], [0.0, 100.0, 0.0, 200.0], [0.0, 0.0, 0.0, 1.0]])
def test_few_cameras_are_one_stretch(places: list[float]) -> None:
    assert parts_of(walk_of(along(places))) == [list(range(len(places)))]


def test_a_walk_that_cannot_close_begins_behind_its_last_jump() -> None:
    """Closing from 4 back to 0 would fly past everything; from the second stretch to the first one likewise."""
    open_walk = walk_of(along([float(place) for place in range(10)]), closed=True)
    assert (parts_of(open_walk), open_walk.closed) == ([list(range(10))], False)
    ring = walk_of(standing(torch.arange(0, 360, 20)), closed=True)
    assert (parts_of(ring), ring.closed) == ([list(range(18))], True)
    arcs = walk_of(standing(torch.tensor([0, 5, 10, 15, 180, 185, 190, 195])), closed=True)
    assert (parts_of(arcs), arcs.closed) == ([[0, 1, 2, 3], [4, 5, 6, 7]], False)
    split = walk_of(standing(torch.tensor([10, 15, 180, 185, 190, 195, 0, 5])), closed=True)
    assert parts_of(split) == [[6, 7, 0, 1], [2, 3, 4, 5]]


def looking_in(degrees: Tensor, radius: float = 2.0) -> Cameras:
    """Return cameras at angles (M,) on a circle around the z axis that look at the origin."""
    angles = torch.deg2rad(degrees.float())
    places = torch.stack([radius * angles.cos(), radius * angles.sin(), torch.zeros(len(angles))], -1)
    poses = torch.stack([look_at(place, torch.zeros(3)) for place in places])
    ones = torch.ones(len(poses))
    return Cameras(poses, ones, ones, ones, ones, ones.long(), ones.long())


def test_a_tour_of_a_ring_is_a_circle_at_even_speed_that_closes() -> None:
    draws = torch.Generator().manual_seed(3)
    cameras = looking_in(torch.randperm(48, generator=draws) * 7.5)
    order = shortest_order(cameras)
    assert sorted(order.tolist()) == list(range(48))
    cameras = cameras[order]
    walk = walk_of(cameras, closed=True)
    assert walk.closed
    path = interpolate(cameras, fractions(60), walk).camera_to_worlds
    centers = path[:, :, 3]
    radii = centers.norm(dim=-1)
    assert float(radii.std()) < 1e-3  # smoothing draws the circle in a little, by the same everywhere
    assert 1.8 < float(radii.mean()) < 2
    steps = (centers.roll(-1, 0) - centers).norm(dim=-1)  # the last one leads back to the first frame
    torch.testing.assert_close(steps, steps.mean().expand(60), rtol=5e-3, atol=0)
    assert float(steps.mean()) == pytest.approx(2 * float(radii.mean()) * math.sin(math.pi / 60), rel=1e-3)
    torch.testing.assert_close(-path[:, :, 2], -centers / radii[:, None], atol=1e-3, rtol=0)
    for pose in path:
        check_pose(pose, "tour")


def test_a_walk_goes_at_even_speed_past_uneven_cameras() -> None:
    """Cameras on a line, dense in its first half: a frame is as far from the next one there as elsewhere."""
    cameras = along([0.1 * place for place in range(60)] + [6 + 0.4 * place for place in range(15)])
    places = interpolate(cameras, fractions(50, closed=False), walk_of(cameras)).camera_to_worlds[:, 0, 3]
    steps = places.diff()
    torch.testing.assert_close(steps, steps.mean().expand(49), rtol=0.02, atol=0)
    eased = interpolate(cameras, fractions(50, closed=False, ease=True), walk_of(cameras)).camera_to_worlds[:, 0, 3]
    shares = (eased - places[0]) / (places[-1] - places[0])
    torch.testing.assert_close(shares.double(), fractions(50, closed=False, ease=True), atol=2e-3, rtol=0)


def test_turning_on_the_spot_takes_time_too() -> None:
    """Eight cameras side by side, then as many that turn by a quarter: the turn is not done in one frame."""
    forward = along([0.25 * place for place in range(8)]).camera_to_worlds
    turned = forward[-1:].repeat(8, 1, 1)
    angles = torch.linspace(0, math.pi / 2, 8)
    turned[:, 0, 0], turned[:, 0, 2], turned[:, 2, 0], turned[:, 2, 2] = (
        angles.cos(), angles.sin(), -angles.sin(), angles.cos()
    )  # fmt: skip
    cameras = replace_poses(along([0.0]), torch.cat([forward, turned]))
    path = interpolate(cameras, fractions(40, closed=False), walk_of(cameras)).camera_to_worlds
    turns = torch.rad2deg(torch.arccos((path[1:, :, 2] * path[:-1, :, 2]).sum(-1).clamp(-1, 1)))
    assert float(turns.max()) < 8


def test_cameras_look_at_one_point() -> None:
    point = torch.tensor([0.5, -2.0, 1.0])
    around = [torch.tensor([3 * math.cos(a), 3 * math.sin(a), 1.0]) + point for a in (0.0, 0.7, 1.9, 2.5)]
    towards = torch.stack([look_at(place, point, UP) for place in around])
    away = torch.stack([look_at(place, 2 * place - point, UP) for place in around])
    found = looked_at(towards)
    assert found is not None
    torch.testing.assert_close(found.float(), point, atol=1e-4, rtol=0)
    assert looked_at(away) is None

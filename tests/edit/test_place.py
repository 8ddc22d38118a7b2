"""Placement: rotations against scipy, harmonics in rotated directions, floors and points that are known."""

import dataclasses
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from nerfloom import edit
from nerfloom.base.errors import ConfigError, DataError, FlagError
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.scale import Scale
from nerfloom.edit.edited import Edited
from nerfloom.evaluation.paths import look_at
from nerfloom.geometry.alignment import align
from nerfloom.splats.drawn import DrawnGaussians
from nerfloom.splats.files import read_gaussians
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.placement import placed_gaussians
from nerfloom.training.loaded import Loaded
from tests.edit.clouds import at, scattered
from tests.splats.test_files import covariances, directions, published, seen
from tests.splats.test_gltf import light_from, read

SHIFT = torch.tensor([5e5, 5.4e6, 300.0], dtype=torch.float64)


def precise(count: int = 30, terms: int = 15) -> Edited:
    """Gaussians with float64 numbers."""
    given = scattered(count, terms=terms).gaussians.map(torch.Tensor.double)
    sizes = given.log_scales + torch.randn(count, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    return Edited(dataclasses.replace(given, log_scales=sizes))


def colors(gaussians: Gaussians, direction: Tensor) -> Tensor:
    """Colours (N, 3) from a direction, less the constant part, float64."""
    return gaussians.harmonics.double() @ published(direction)[: gaussians.harmonics.shape[2]]


@pytest.mark.parametrize("terms", [0, 3, 8, 15])
def test_a_rotation_is_scipys_and_turns_the_harmonics(terms: int) -> None:
    edited, axis, center = precise(terms=terms), np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.1, -2.0])
    turn = Rotation.from_rotvec(math.radians(130) * axis / np.linalg.norm(axis))
    turned = edit.rotate(edited, (1.0, -2.0, 0.5), 130.0, (0.3, 0.1, -2.0)).gaussians
    expected = turn.apply(edited.gaussians.means.numpy() - center) + center
    np.testing.assert_allclose(turned.means, expected, atol=1e-12)
    matrix = torch.from_numpy(turn.as_matrix())
    spread = matrix @ covariances(edited.gaussians) @ matrix.T
    torch.testing.assert_close(covariances(turned), spread, atol=1e-12, rtol=1e-10)
    for direction in directions(20):
        torch.testing.assert_close(
            colors(turned, matrix @ direction), colors(edited.gaussians, direction), atol=1e-12, rtol=1e-10
        )


def test_a_scale_keeps_a_point_and_scales_sizes() -> None:
    edited = precise()
    scaled = edit.scale(edited, 2.5, (1.0, 2.0, 3.0)).gaussians
    center = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    torch.testing.assert_close(scaled.means, center + 2.5 * (edited.gaussians.means - center))
    torch.testing.assert_close(covariances(scaled), 6.25 * covariances(edited.gaussians))


def test_a_scale_names_the_unit_or_forgets_it() -> None:
    metres = dataclasses.replace(scattered(5), scale=Scale(0.5, "m"))
    assert edit.move(metres, (1.0, 0.0, 0.0)).scale == Scale(0.5, "m")
    assert edit.rotate(metres, (1.0, 0.0, 0.0), 30.0).scale == Scale(0.5, "m")
    assert not edit.scale(metres, 100.0).scale.is_known
    assert edit.scale(edit.scale(metres, 10.0), 10.0, unit="cm").scale == Scale(50.0, "cm")
    assert edit.scale(metres, 100.0, unit="cm").scale == Scale(50.0, "cm")
    rough = dataclasses.replace(metres, scale=Scale(0.5, "m", 0.02))
    assert edit.scale(rough, 100.0, unit="cm").scale == Scale(50.0, "cm", 0.02)
    with pytest.raises(FlagError, match="short name"):
        edit.scale(metres, 2.0, unit="<script>")


def test_what_has_been_moved_stays_where_it_was_in_the_scene() -> None:
    """The error is below a micrometre in the coordinates of a survey, and harmonics agree as well."""
    turn = torch.from_numpy(Rotation.random(random_state=3).as_matrix())
    placement = Placement(torch.cat([turn, -(turn @ SHIFT)[:, None]], -1), 0.25)
    given = scattered(50, terms=8)
    edited = dataclasses.replace(
        given, gaussians=dataclasses.replace(given.gaussians, means=given.gaussians.means + SHIFT), placement=placement
    )
    truth = placement.points(edited.gaussians.means)
    moved = edit.move(edit.rotate(edited, (0.2, 1.0, -1.0), 200.0), (7.0, -8.0, 9e5))
    moved = edit.set_up(edit.scale(moved, 0.1, (3.0, 3.0, 3.0)), (0.0, -1.0, 0.0))
    assert float((moved.gaussians.means - edited.gaussians.means).norm(dim=-1).min()) > 1
    torch.testing.assert_close(moved.placement.points(moved.gaussians.means), truth, atol=1e-6, rtol=0)
    to_scene, from_start = moved.placement.transform[:, :3], placement.transform[:, :3]
    for direction in directions(5):
        torch.testing.assert_close(
            colors(moved.gaussians, to_scene.T @ direction),
            colors(edited.gaussians, from_start.T @ direction),
            atol=1e-5,
            rtol=0,
        )


@pytest.mark.parametrize("up", [(0.0, -1.0, 0.0), (0.0, 0.0, -3.0), (1.0, 2.0, -0.5), (0.0, 0.0, 1.0)])
def test_up_becomes_z(up: tuple[float, float, float]) -> None:
    length = math.sqrt(sum(value * value for value in up))
    points = torch.tensor([up, (0.0, 0.0, 0.0)], dtype=torch.float64) / length
    found = edit.set_up(Edited(at(points)), up).gaussians.means
    torch.testing.assert_close(found, torch.tensor([[0.0, 0, 1], [0, 0, 0]], dtype=torch.float64), atol=1e-9, rtol=0)


def test_no_direction_is_refused() -> None:
    with pytest.raises(ConfigError, match="no direction"):
        edit.set_up(scattered(5), (0.0, 0.0, 0.0))
    with pytest.raises(ConfigError, match="no direction"):
        edit.rotate(scattered(5), (0.0, 0.0, 0.0), 10.0)


def test_three_points_come_to_their_targets() -> None:
    """The similarity is known, and found exactly; without its scale, the shape keeps its size."""
    edited, turn = scattered(20), Rotation.random(random_state=1)
    corners = np.array([[0.0, 0, 0], [2.0, 0.1, 0], [0.3, 1.0, 0.5]])

    def moved(points: np.ndarray) -> np.ndarray:
        return 3.0 * turn.apply(points) + np.array([10.0, -20.0, 5.0])

    pairs = [tuple(map(tuple, points.tolist())) for points in (corners, moved(corners))]
    found = edit.align_points(edited, *pairs).gaussians  # type: ignore[arg-type]
    np.testing.assert_allclose(found.means, moved(edited.gaussians.means.numpy()), atol=1e-9)
    rigid = edit.align_points(edited, *pairs, with_scale=False).gaussians  # type: ignore[arg-type]
    expected = turn.apply(edited.gaussians.means.numpy() - corners.mean(0)) + moved(corners).mean(0)
    np.testing.assert_allclose(rigid.means, expected, atol=1e-9)


def test_points_on_a_line_are_refused() -> None:
    line = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (2.0, 2.0, 2.0))
    with pytest.raises(DataError, match="line"):
        edit.align_points(scattered(5), line, line)
    with pytest.raises(DataError, match="three or more"):
        edit.align_points(scattered(5), (), ())


def room(tilt: float) -> tuple[Edited, Tensor]:
    """A tilted floor, things on it, a larger wall, faint Gaussians below, and true heights; the floor is first."""
    random = torch.Generator().manual_seed(0)

    def uniform(count: int, low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, generator=random, dtype=torch.float64)

    floor = torch.stack([uniform(1500, -3, 3), uniform(1500, -3, 3), uniform(1500, 0, 0)], -1)
    wall = torch.stack([uniform(2500, 3, 3), uniform(2500, -3, 3), uniform(2500, 0, 4)], -1)
    things = torch.stack([uniform(800, -1, 1), uniform(800, -1, 1), uniform(800, 0.2, 1.5)], -1)
    below = torch.stack([uniform(3000, -3, 3), uniform(3000, -3, 3), uniform(3000, -0.5, -0.5)], -1)
    flat = torch.cat([floor, wall, things, below])
    turn = torch.from_numpy(Rotation.from_euler("xyz", [tilt, 0.4 * tilt, 50.0], degrees=True).as_matrix())
    shift = torch.tensor([4.0, -7.0, 2.5], dtype=torch.float64)
    given = at(flat @ turn.T + shift)
    given.logits[-3000:] = -4.0
    return Edited(given), flat[:, 2]


@pytest.mark.parametrize("tilt", [0.0, 12.0, -30.0])
def test_a_tilted_floor_becomes_the_plane_z_is_0(tilt: float) -> None:
    """The error is below a millionth; all heights are above it, and its middle is the origin."""
    edited, heights = room(tilt)
    placed = edit.align_floor(edited)
    found = placed.gaussians.means
    assert float((found[:, 2] - heights).abs().max()) < 1e-6
    again = edit.align_floor(edited)
    assert torch.equal(again.gaussians.means, found)
    torch.testing.assert_close(found[:1500].mean(0), torch.zeros(3).double(), atol=1e-6, rtol=0)


@pytest.mark.parametrize("tilt", [0.0, 12.0])
@pytest.mark.parametrize(("subject", "is_seen"), [((1.0, -0.5, 0.8), True), ((1.0, -0.5, -0.3), False)])
def test_the_origin_is_under_what_the_cameras_look_at(
    tilt: float, subject: tuple[float, float, float], is_seen: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    """A point of the room, with cameras around it in a scene of another place and scale; or one below the floor."""
    edited, _ = room(tilt)
    placement = Placement(COLMAP, 0.25)
    turn = Rotation.from_euler("xyz", [tilt, 0.4 * tilt, 50.0], degrees=True)
    point = torch.from_numpy(turn.apply(subject)) + torch.tensor([4.0, -7.0, 2.5])
    poses = torch.stack([look_at(point + 3 * away, point) for away in directions(12)])
    scene = dataclasses.replace(
        placed_gaussians(edited.gaussians)[1], camera_to_worlds=placement.poses(poses).float(), num_cameras=12
    )
    model = DrawnGaussians(edited.gaussians, edited.look, scene)
    loaded = Loaded(model, placement, "gaussian-splatting", Path("a.ply"), Path("a.ply"))
    x, y, z = turn.apply([0.0, 0, 1]).tolist()
    known = dataclasses.replace(edited, loaded=loaded, placement=placement)
    placed = edit.align_floor(known, up=(x, y, z)).gaussians.means
    assert ("under the point" in capsys.readouterr().err) == is_seen
    factor, rotation, shift = align(edited.gaussians.means[::50], placed[::50])  # what has been done to all of it
    assert factor == pytest.approx(1)
    foot = rotation @ point + shift if is_seen else placed[:1500].mean(0)
    torch.testing.assert_close(foot[:2], torch.zeros(2).double(), atol=1e-4, rtol=0)
    assert float(foot[2]) == pytest.approx(subject[2] if is_seen else 0, abs=1e-4)


def test_the_share_on_the_floor_is_counted_at_the_distance_that_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    """A floor that is thicker than what the fit counts."""
    edited, heights = room(12.0)
    up = torch.from_numpy(Rotation.from_euler("xyz", [12.0, 4.8, 50.0], degrees=True).as_matrix()[:, 2])
    off = torch.zeros_like(heights)
    off[:1500] = torch.linspace(-0.06, 0.06, 1500, dtype=torch.float64)[torch.randperm(1500)]
    moved = edited.gaussians.means + off[:, None] * up
    thick = dataclasses.replace(edited, gaussians=dataclasses.replace(edited.gaussians, means=moved))
    edit.align_floor(dataclasses.replace(thick, scale=Scale(1.0, "cm")))
    said = re.search(r"(\d+)% of the opaque Gaussians are within (\S+) cm of the floor", capsys.readouterr().err)
    assert said is not None
    opaque = (heights + off)[:-3000].abs()
    assert 0.06 < float(said[2]) < 0.1  # a hundredth of the room's diagonal, which is 8 between the percentiles
    assert int(said[1]) == pytest.approx(100 * float((opaque <= float(said[2])).double().mean()), abs=1)


def test_a_floor_of_another_up_direction() -> None:
    """Turned by 100 degrees, it is found where up is said to be, and not otherwise."""
    edited, heights = room(0.0)
    turned = edit.rotate(edited, (1.0, 0.0, 0.0), 100.0)
    up = (0.0, -math.sin(math.radians(100)), math.cos(math.radians(100)))
    found = edit.align_floor(turned, up=up).gaussians.means
    assert float((found[:, 2] - heights).abs().max()) < 1e-6


@pytest.mark.parametrize("degrees", [-90.0, 100.0, 180.0])
def test_a_floor_is_found_where_the_scene_is_up(degrees: float) -> None:
    """The scene has another up direction in its axes, or set_up has changed it."""
    edited, heights = room(0.0)
    turned = edit.rotate(edited, (1.0, 0.0, 0.0), degrees)
    assert float((edit.align_floor(turned).gaussians.means[:, 2] - heights).abs().max()) < 1e-6
    radians = math.radians(degrees)
    alone = edit.set_up(Edited(turned.gaussians), (0.0, -math.sin(radians), math.cos(radians)))
    again = edit.align_floor(edit.rotate(alone, (0.0, 1.0, 0.0), degrees))
    assert float((again.gaussians.means[:, 2] - heights).abs().max()) < 1e-6


def test_no_floor_is_said() -> None:
    with pytest.raises(ConfigError, match="opaque"):
        edit.align_floor(Edited(at(torch.randn(50, 3), logit=-5.0)))
    vertical = torch.stack([torch.zeros(300), torch.rand(300), torch.rand(300)], -1)
    with pytest.raises(ConfigError, match="no floor is found"):
        edit.align_floor(Edited(at(vertical)), max_tilt=20.0)


COLMAP = torch.tensor([[1.0, 0, 0, 2.0], [0, 0, 1.0, -1.0], [0, -1.0, 0, 5.0]], dtype=torch.float64)
"""Transform from axes x right, y down, z ahead to a scene with +z up, with a shift."""


@pytest.mark.parametrize("known", ["set_up", "scene"])
def test_up_is_y_in_a_glb_file(known: str, tmp_path: Path) -> None:
    """Heights are -y of COLMAP's axes, whether set_up or the scene says so, and after later rotations."""
    given, up = scattered(30, terms=15), (0.0, -1.0, 0.0)
    by_scene = dataclasses.replace(given, placement=Placement(COLMAP, 0.25))
    edited = edit.set_up(given, up) if known == "set_up" else by_scene
    heights = -given.gaussians.means[:, 1].numpy()
    colours = seen(given.gaussians, torch.tensor(up).double()).numpy()
    for each in (edited, edit.rotate(edited, (1.0, 0.0, 0.0), 70.0), edit.rotate(edited, (0.0, 0.0, 1.0), 30.0)):
        each.write(tmp_path / "a.glb")
        found = read(tmp_path / "a.glb")[1]
        np.testing.assert_allclose(found["POSITION"][:, 1], heights, rtol=0, atol=1e-5)
        light = light_from(found, torch.tensor([0.0, 1.0, 0.0]).double())
        np.testing.assert_allclose(light, colours, rtol=0, atol=1e-5)
        each.write(tmp_path / "a.ply")  # which is not turned
        positions = read_gaussians(tmp_path / "a.ply").gaussians.means
        torch.testing.assert_close(positions, each.gaussians.means.float(), rtol=0, atol=0)
    level = edit.scale(edit.set_up(by_scene, up), 2.0)
    level.write(tmp_path / "a.glb")
    np.testing.assert_allclose(read(tmp_path / "a.glb")[1]["POSITION"][:, 1], 2 * heights, rtol=0, atol=1e-5)
    torch.testing.assert_close(level.gaussians.means[:, 2], 2 * torch.from_numpy(heights), rtol=0, atol=1e-9)

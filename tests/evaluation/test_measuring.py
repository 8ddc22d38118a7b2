"""Points at pixels, the cameras that see them, and lengths, in scenes that are known exactly."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError, DataError
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.refinement import PoseRefinement
from nerfloom.cameras.scale import Scale
from nerfloom.cameras.triangulation import point_covariance, projection_jacobians, reading_error
from nerfloom.cameras.view import View
from nerfloom.data.parsed_scene import ParsedScene
from nerfloom.data.scene import Scene
from nerfloom.evaluation.measuring import (
    PIXEL_ERROR,
    Length,
    located,
    measured,
    scale_of,
    seeing_cameras,
    surface_point,
)
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays
from nerfloom.renderable import RendersRays
from nerfloom.rendering.rendered import Picture, Rendered
from nerfloom.splats.drawn import DrawnGaussians
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import OURS
from nerfloom.testing.ball import RADIUS, cameras_at
from nerfloom.training.loaded import Loaded

SCENE = Scene(torch.tensor([[-1.0] * 3, [1.0] * 3]), 0.1, 10.0, 4, True, False, 32, image_pixels=32 * 32)


class Ball(RendersRays):
    """A ball around the origin, with a depth that is off by a fraction."""

    scene = SCENE
    device = torch.device("cpu")
    rays_at_once = 10_000

    def __init__(self, off: float = 0.0) -> None:
        self.off = off

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        middle = -(rays.origins * rays.directions).sum(-1)
        square = RADIUS**2 - (rays.origins + middle[:, None] * rays.directions).square().sum(-1)
        hit = square > 0
        depth = torch.where(hit, (middle - square.clamp(min=0).sqrt()) * (1 + self.off), rays.fars)
        return Rendered(torch.zeros(len(depth), 3), depth, depth, hit.float(), len(depth))

    def render_view(self, view: View, background: Tensor) -> Picture:
        raise NotImplementedError


class Surface(Ball):
    """The same with a signed distance, of a slope that is not 1."""

    def signed_distance(self, points: Points) -> tuple[Tensor, Tensor]:
        length = points.positions.norm(dim=-1)
        return 1.5 * (length**2 - RADIUS**2), 3 * points.positions


class Coated(Ball):
    """The same, with a coat of its own in each training image."""

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        rendered = super().render(rays, background)
        if rays.camera_indices is None:
            return rendered
        return replace(rendered, median_depth=rendered.median_depth - 0.1 * (1 + rays.camera_indices))


class Refined(Ball):
    """The same, with training cameras away from the data's poses: all are moved alike."""

    def __init__(self, count: int, shift: Tensor) -> None:
        super().__init__()
        self.poses = PoseRefinement(count)
        self.poses.tangents.data[:, :3] = shift

    def refined_poses(self, poses: Tensor, training: bool) -> Tensor:
        return self.poses.refined(poses, training)


def around(count: int = 40) -> Cameras:
    """Cameras at random places 3 from the origin."""
    generator = torch.Generator().manual_seed(0)
    places = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    return cameras_at(3 * places, 40, 100)


@pytest.mark.parametrize(("model", "tolerance"), [(Ball(), 1e-6), (Ball(0.002), 8e-3), (Surface(0.002), 1e-6)])
def test_the_point_at_a_pixel(model: Ball, tolerance: float) -> None:
    """The point is on the ball, and seen at that pixel; a signed distance mends a depth that is a little off."""
    cameras = around()
    for column, row in ((49.5, 49.5), (30.2, 61.7)):
        point = surface_point(model, View.of(cameras, 3), column, row)
        assert float(point.norm()) == pytest.approx(RADIUS, abs=tolerance)
        there = cameras.project(point.float()[None], 3)
        assert [float(value) for value in there[:2]] == pytest.approx([column, row], abs=1e-3)


def test_a_depth_far_from_the_level_set_is_kept() -> None:
    """The pixel shows matter before the surface, such as a floater."""
    point = surface_point(Surface(-0.1), View.of(around(), 3), 49.5, 49.5)
    assert float(point.norm()) == pytest.approx(3 - 0.9 * (3 - RADIUS), abs=1e-5)


def test_a_pixel_beside_the_ball_has_no_point() -> None:
    with pytest.raises(ConfigError, match="no surface at column 1"):
        surface_point(Ball(), View.of(around(), 3), 1, 1)


@pytest.mark.parametrize(("column", "row"), [(-0.6, 50.0), (50.0, 99.6), (math.nan, 50.0)])
def test_a_pixel_outside_of_the_image_has_no_point(column: float, row: float) -> None:
    with pytest.raises(ConfigError, match="100 x 100 pixels"):
        surface_point(Ball(), View.of(around(), 3), column, row)


def test_a_pixel_without_a_ray_has_no_point() -> None:
    """The distorted radius r - r^3 is at most 0.38, and 0.5 at this pixel."""
    cameras = around()
    lens = torch.tensor([[-1.0, 0, 0, 0, 0, 0, 0, 0, 0]]).expand(len(cameras), -1)
    with pytest.raises(ConfigError, match="opencv lens has no ray at column 1"):
        surface_point(Ball(), View.of(replace(cameras, model="opencv", lens=lens), 3), 1, 1)


def test_the_camera_of_a_picture_is_no_training_camera() -> None:
    cameras, model = around(), Coated()
    point = surface_point(model, View.of(cameras, 3), 30.2, 61.7)
    assert float(point.norm()) == pytest.approx(RADIUS, abs=1e-6)
    assert torch.equal(seeing_cameras(model, cameras, point), seeing_cameras(Ball(), cameras, point))


def test_lengths_are_measured_where_the_refined_cameras_stand() -> None:
    """The data have all cameras moved by the same way; with refined poses, pixels, points and errors are the ball's."""
    true, shift = around(), torch.tensor([0.3, -0.2, 0.4])
    wrong = true.camera_to_worlds.clone()
    wrong[:, :, 3] -= shift
    given = replace(true, camera_to_worlds=wrong)
    files = tuple(Path(f"{index}.png") for index in range(len(true)))

    def parse(split: str) -> ParsedScene:
        if split != "train":
            raise DataError("no such images")
        return ParsedScene(files, given, SCENE.box, SCENE.near, SCENE.far)

    source: Any = SimpleNamespace(parse=parse)
    model = Refined(len(true), shift)
    moved = Loaded(model, Placement.of(None, 1.0), "ball", Path("run"), Path("run/step"), source=source)
    ends = [moved.pick(moved.photograph(f"{index}.png"), 49.5, 49.5) for index in (3, 7)]
    for index, end in zip((3, 7), ends, strict=True):
        expected = RADIUS * torch.nn.functional.normalize(true.camera_to_worlds[index, :, 3], dim=0)
        torch.testing.assert_close(end.float(), expected, atol=1e-3, rtol=0)
    found = moved.measure(*ends)
    exact = measured(Ball(), true, (ends[0], ends[1]), 1.0, Scale())
    assert found.value == pytest.approx(exact.value)
    assert found.error == pytest.approx(exact.error, rel=1e-4)
    torch.testing.assert_close(moved.parsed("train").cameras.camera_to_worlds, true.camera_to_worlds)


def test_the_cameras_that_see_a_point() -> None:
    """The cameras are above the plane that touches the ball there, and have the point inside their image."""
    cameras = around()
    point = RADIUS * torch.nn.functional.normalize(torch.tensor([1.0, 0.4, -0.2], dtype=torch.float64), dim=0)
    height = cameras.camera_to_worlds[:, :, 3].double() @ point / RADIUS
    sure = (height - RADIUS).abs() > 0.3  # others look along the surface
    found = torch.zeros(len(cameras), dtype=torch.bool)
    found[seeing_cameras(Ball(), cameras, point)] = True
    assert torch.equal(found[sure], (height > RADIUS)[sure])
    assert 5 < int(found.sum()) < len(cameras) / 2
    far = torch.tensor([0.0, 0.0, 50.0], dtype=torch.float64)
    assert len(seeing_cameras(Ball(), cameras, far)) == 0


def test_a_length_and_its_error() -> None:
    cameras, model = around(), Surface()
    ends = [RADIUS * torch.nn.functional.normalize(torch.tensor(each).double(), dim=0)
            for each in ([1.0, 0.4, -0.2], [0.8, -0.3, 0.4])]  # fmt: skip
    scale, unit = Scale(0.5, "m", 0.02), 0.25
    found = measured(model, cameras, (ends[0], ends[1]), unit, scale)
    length = float((ends[1] - ends[0]).norm())
    assert found.value == pytest.approx(unit * length)
    along = (ends[1] - ends[0]) / length
    square = 0.0
    for end in ends:
        jacobians = projection_jacobians(cameras[seeing_cameras(model, cameras, end)], end)
        square += float(along @ point_covariance(jacobians, PIXEL_ERROR) @ along)
        square += reading_error(jacobians, PIXEL_ERROR) ** 2
    assert found.error == pytest.approx(unit * math.hypot(square**0.5, 0.02 * length))
    exact = measured(model, cameras, (ends[0], ends[1]), unit, Scale(0.5, "m"))
    assert exact.error is not None
    true = scale_of(exact, Scale(0.5, "m"), 30.0, "cm")
    assert true.factor == pytest.approx(0.5 * 30 / (unit * length))
    assert true.relative_error == pytest.approx(exact.error / exact.value)


def test_errors_that_are_not_known() -> None:
    cameras, ends = around(), (torch.tensor([RADIUS, 0, 0]), torch.tensor([0, RADIUS, 0]))
    for given in (None, cameras[:1], cameras[:0]):
        assert measured(Ball(), given, ends, 1.0, Scale()).error is None
    for few in (cameras[:0], cameras[:1]):
        assert bool(located(Ball(), few, ends[0]).isinf().all())
    unknown = scale_of(measured(Ball(), None, ends, 1.0, Scale()), Scale(), 2.0, "m")
    assert unknown.relative_error is None
    assert "unknown error" in unknown.words()
    seen = tuple(RADIUS * torch.nn.functional.normalize(torch.tensor(each).double(), dim=0)
                 for each in ([1.0, 0.4, -0.2], [0.8, -0.3, 0.4]))  # fmt: skip
    assert measured(Ball(), cameras, (seen[0], seen[1]), 1.0, Scale()).error is not None
    assert measured(Ball(), cameras, (seen[0], seen[1]), 1.0, unknown).error is None
    with pytest.raises(ConfigError, match="same"):
        measured(Ball(), cameras, (ends[0], ends[0]), 1.0, Scale())


def test_a_gaussian_is_picked_at_its_centre() -> None:
    """A method that casts no rays."""
    centre = torch.tensor([[0.2, -0.1, 0.3]])
    one = Gaussians(centre, torch.full((1, 3), -3.0), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1,), 8.0),
                    torch.zeros(1, 3), torch.zeros(1, 3, 0))  # fmt: skip
    model, cameras = DrawnGaussians(one, OURS, SCENE), around()
    column, row, _ = cameras.project(centre, 5)
    point = surface_point(model, View.of(cameras, 5), float(column), float(row))
    torch.testing.assert_close(point.float(), centre[0], atol=1e-4, rtol=0)
    assert len(seeing_cameras(model, cameras, point)) == len(cameras)  # nothing hides it


def loaded(source: Any = None, **facts: Any) -> Loaded:
    """The ball, in a scene with other facts."""
    model = Ball()
    model.scene = replace(SCENE, **facts)
    return Loaded(model, Placement.of(None, 1.0), "ball", Path("run"), Path("run/step"), source=source)


@pytest.mark.parametrize(("facts", "words"), [({"warped": True}, "--ndc"), ({"num_scenes": 2}, "2 scenes")])
def test_runs_without_lengths(facts: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        loaded(**facts).pick(View.of(around(), 3), 49.5, 49.5)
    with pytest.raises(ConfigError, match=words):
        loaded(**facts).measure([0, 0, 0], [1, 0, 0])


def test_a_point_is_picked_in_the_picture_of_one_camera() -> None:
    cameras = around()
    one = loaded().pick(cameras[3:4], 49.5, 49.5)
    torch.testing.assert_close(one, loaded().pick(View.of(cameras, 3), 49.5, 49.5))
    with pytest.raises(ValueError, match="choose one"):
        loaded().pick(cameras, 49.5, 49.5)


def test_half_a_pixel_is_one_of_the_images_that_were_learnt_from() -> None:
    """It is twice as long for images of half the size."""
    ends = [RADIUS * torch.nn.functional.normalize(torch.tensor(each).double(), dim=0)
            for each in ([1.0, 0.4, -0.2], [0.8, -0.3, 0.4])]  # fmt: skip
    errors = []
    for factor in (1, 2):
        parsed = ParsedScene((), around(), SCENE.box, SCENE.near, SCENE.far, downscale_factor=factor)
        found = loaded(SimpleNamespace(parse={"train": parsed}.get)).measure(*ends)
        assert found.error is not None
        errors.append(found.error)
    assert errors[1] == pytest.approx(2 * errors[0], rel=1e-5)


@pytest.mark.parametrize(
    ("length", "text"),
    [
        (Length(0.21341, 0.00114, "m"), "0.2134 m ± 0.0011 m"),
        (Length(21.341, 0.3, "cm"), "21.34 cm ± 0.30 cm"),
        (Length(1234.6, 17.3, "mm"), "1235 mm ± 17 mm"),
        (Length(0.79, 0.004, ""), "0.7900 ± 0.0040"),
        (Length(0.79, 0.0, ""), "0.790000 ± 0.000000"),
    ],
)
def test_lengths_as_text(length: Length, text: str) -> None:
    assert str(length) == text
    assert "unknown" in str(Length(1.0, None, "m"))

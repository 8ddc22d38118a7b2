"""A surface judged by a reference, against distances and angles that are known."""

import math
from dataclasses import replace

import pytest
import torch

from nerfloom.base.errors import ConfigError
from nerfloom.cameras.poses import Placement
from nerfloom.evaluation.geometry import FScore, Views, judge_surface
from nerfloom.evaluation.surfaces import Surface, drawn
from nerfloom.testing.ball import cameras_at
from tests.evaluation.surfaces import sphere, square, together

pytest.importorskip("trimesh")
COUNT = 20_000
HERE = Placement(torch.eye(4, dtype=torch.float64)[:3], 1.0)


def test_parallel_squares() -> None:
    found = judge_surface(square(0.03), square(), f_score_at=(0.04, 0.02), count=COUNT)
    assert found.accuracy.mean == pytest.approx(0.03, rel=1e-12)
    assert found.completeness.median == pytest.approx(0.03, rel=1e-12)
    assert found.chamfer == pytest.approx(0.03, rel=1e-12)
    assert [(score.distance, score.f_score) for score in found.f_scores] == [(0.02, 0), (0.04, 1)]
    assert found.normals is not None
    assert found.normals.degrees == pytest.approx(0, abs=1e-5)
    assert found.normals.cosine == 1
    assert found.side == 1


@pytest.mark.medium
def test_concentric_spheres() -> None:
    """Distances are the difference of the radii, up to the triangles' depth of 4e-4."""
    found = judge_surface(sphere(0.9), sphere(1.0), count=COUNT)
    for distances in (found.accuracy, found.completeness):
        assert distances.mean == pytest.approx(0.1, abs=5e-4)
        assert distances.median == pytest.approx(0.1, abs=5e-4)
    assert found.normals is not None
    assert found.normals.degrees < 1.5
    assert found.as_plain()["chamfer_percent"] == pytest.approx(5.0, abs=0.03)


@pytest.mark.parametrize("degrees", [5.0, 30.0])
def test_a_turned_square(degrees: float) -> None:
    """Its normals are off by the angle; its points are |y| sin(angle) off, a quarter of that times the edge."""
    tilted = square(tilt=math.radians(degrees))
    found = judge_surface(tilted, square(), count=4000)
    assert found.normals is not None
    assert found.normals.degrees == pytest.approx(degrees, abs=1e-6)
    assert found.normals.cosine == pytest.approx(math.cos(math.radians(degrees)), abs=1e-9)
    assert found.accuracy.mean == pytest.approx(math.sin(math.radians(degrees)) / 4, rel=0.04)
    assert tilted.faces is not None
    flipped = judge_surface(replace(tilted, faces=tilted.faces.flip(-1)), square(), count=4000)
    assert flipped.normals is not None
    assert flipped.normals.degrees == pytest.approx(degrees, abs=1e-6)


def test_shares_are_areas() -> None:
    """A fifth of the surface is at a height of 0.1; above the reference, which is all found."""
    small = (1 / 4) ** 0.5 / 2
    found = judge_surface(together(square(), square(0.1, small)), square(), f_score_at=(0.05, 0.2), count=COUNT)
    near, far = found.f_scores
    assert near.precision == pytest.approx(0.8, abs=1e-3)
    assert near.recall == 1
    assert near.f_score == pytest.approx(2 * 0.8 / 1.8, abs=1e-3)
    assert far.f_score == 1
    assert found.accuracy.mean == pytest.approx(0.2 * 0.1, abs=1e-4)
    assert found.completeness.mean == pytest.approx(0, abs=1e-12)
    assert found.chamfer == pytest.approx(0.01, abs=1e-4)


def test_an_f_score_of_nothing_is_0() -> None:
    assert FScore(1.0, 0.0, 0.0).f_score == 0
    assert FScore(1.0, 1.0, 0.5).f_score == pytest.approx(2 / 3)


@pytest.mark.medium
def test_the_unit_changes_lengths_alone() -> None:
    """Metres or millimetres, far from the origin."""
    one, other = sphere(0.95, level=3), sphere(1.0, level=3)
    metres = judge_surface(one, other, count=COUNT)
    shift = torch.tensor([5e5, 4e6, 100.0], dtype=torch.float64)
    millimetres = judge_surface(
        *(replace(surface, points=1000 * surface.points + shift) for surface in (one, other)), count=COUNT
    )
    assert millimetres.chamfer == pytest.approx(1000 * metres.chamfer, rel=1e-6)
    assert millimetres.side == pytest.approx(1000 * metres.side, rel=1e-6)
    for a, b in zip(metres.f_scores, millimetres.f_scores, strict=True):
        assert b.distance == pytest.approx(1000 * a.distance, rel=1e-6)
        assert b.f_score == pytest.approx(a.f_score, abs=1e-3)
    assert metres.normals is not None
    assert millimetres.normals is not None
    assert millimetres.normals.degrees == pytest.approx(metres.normals.degrees, abs=0.02)


@pytest.mark.medium
def test_points_as_reference() -> None:
    """Points 0.1 outside of the surface; with normals and without."""
    samples = drawn(sphere(1.1), 50_000)
    found = judge_surface(sphere(), Surface(samples.positions, None, samples.normals), count=COUNT)
    assert found.completeness.mean == pytest.approx(0.1, abs=1e-3)
    assert found.accuracy.mean == pytest.approx(0.1, abs=2e-3)  # the points are 0.017 apart
    assert found.normals is not None
    assert found.normals.degrees < 2
    bare = judge_surface(sphere(), Surface(samples.positions), count=COUNT)
    assert bare.normals is None
    assert bare.chamfer == found.chamfer


@pytest.mark.medium
def test_only_what_cameras_see_counts() -> None:
    """A sphere's far side is wrong, but no camera sees it; the left-out part is known in closed form."""
    right = sphere()
    wrong = replace(right, points=right.points * (1 - 0.3 * (right.points[:, :1] < 0.1)))
    cameras = cameras_at(torch.tensor([[4.0, 0.0, 0.0]]), 60.0, 400)
    views = Views(cameras, HERE, lambda index: None, lambda index: None)
    assert judge_surface(wrong, right, count=COUNT).chamfer > 0.05
    found = judge_surface(wrong, right, views, count=COUNT)
    assert found.chamfer == pytest.approx(0, abs=1e-5)
    assert found.reference_left_out.hidden == pytest.approx(0.625, abs=0.02)
    assert found.reference_left_out.total == found.reference_left_out.hidden
    assert "hidden" in found.reference_left_out.describe()
    with pytest.raises(ConfigError, match=r"no point of the surface counts: 100\.0% left out"):
        judge_surface(wrong, right, replace(views, least=2), count=COUNT)


@pytest.mark.medium
def test_cameras_are_in_another_frame_than_the_surface() -> None:
    """A scene placed with another scale, turn and origin: the same points count."""
    angle = torch.tensor(0.7)
    turn = torch.tensor([[angle.cos(), -angle.sin(), 0], [angle.sin(), angle.cos(), 0], [0, 0, 1]], dtype=torch.float64)
    placement = Placement(torch.cat([turn, torch.tensor([[1.0], [2], [3]]).double()], -1), 0.01)
    cameras = cameras_at(torch.tensor([[4.0, 0.0, 0.0]]), 60.0, 400)
    big = replace(sphere(), points=placement.original_points(sphere().points))
    views = Views(cameras, placement, lambda index: None, lambda index: None)
    found = judge_surface(big, big, views, count=COUNT)
    assert found.side == pytest.approx(200, rel=0.01)
    assert found.left_out.hidden == pytest.approx(0.625, abs=0.02)


@pytest.mark.medium
def test_a_surface_far_from_the_reference_is_judged_and_not_left_out() -> None:
    """The surface is inside of the reference, which would hide it: its distances count all the same."""
    cameras = cameras_at(torch.tensor([[4.0, 0.0, 0.0], [-4.0, 0.0, 0.0]]), 60.0, 400)
    views = Views(cameras, HERE, lambda index: None, lambda index: None)
    found = judge_surface(sphere(0.5), sphere(), views, count=1000)
    assert found.accuracy.mean == pytest.approx(0.5, abs=1e-3)
    assert found.warning is not None
    assert "same frame and unit" in found.warning
    assert judge_surface(sphere(0.9), sphere(), count=COUNT).warning is None


def test_a_crop_leaves_out_what_is_beyond() -> None:
    """A square five times as high as the reference's box reaches is none of the reference's business."""
    surface = together(square(), square(5.0))
    assert judge_surface(surface, square(), count=COUNT).accuracy.mean == pytest.approx(2.5, rel=1e-3)
    found = judge_surface(surface, square(), crop=0.1, count=COUNT)
    assert found.accuracy.mean == pytest.approx(0, abs=1e-12)
    assert found.left_out.beyond == pytest.approx(0.5, abs=1e-3)
    assert "outside of --crop" in found.left_out.describe()

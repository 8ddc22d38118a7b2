"""The part of a mesh that cameras see."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.cameras.cameras import Cameras
from nerfloom.export import seen
from nerfloom.export.mesh import Mesh, closedness
from nerfloom.export.seen import default_min_views, seen_faces, seen_part
from nerfloom.export.settings import TsdfSettings
from nerfloom.export.surface import surface_mesh
from nerfloom.testing.ball import cameras_at
from tests.export.test_mesh import sphere, together
from tests.test_surfaces import trainer_of
from tests.training.helpers import said_otherwise

pytest.importorskip("trimesh")


@pytest.fixture(autouse=True)
def few_points(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(seen, "OCCLUDERS", 200_000)


def above(count: int = 6) -> Cameras:
    """Cameras around the z axis that look down at the origin from a distance of 5."""
    turn = torch.arange(count) / count * 2 * torch.pi
    return cameras_at(torch.stack([3 * turn.cos(), 3 * turn.sin(), torch.full_like(turn, 4.0)], -1), 60.0, 300)


def plate(height: float, cells: int = 40, half: float = 1.0, up: bool = True) -> Mesh:
    """A square of triangles at a height, with faces that look up or down."""
    side = torch.linspace(-half, half, cells + 1, dtype=torch.float64)
    x, y = torch.meshgrid(side, side, indexing="ij")
    vertices = torch.stack([x, y, torch.full_like(x, height)], -1).view(-1, 3)
    corner = (torch.arange(cells)[:, None] * (cells + 1) + torch.arange(cells)).reshape(-1)
    right, beyond = corner + cells + 1, corner + 1
    faces = torch.cat([torch.stack([corner, right, beyond], -1), torch.stack([right, right + 1, beyond], -1)])
    return Mesh(vertices, faces if up else faces.flip(-1))


def middles(mesh: Mesh) -> Tensor:
    return mesh.vertices[mesh.faces].mean(1)


@pytest.mark.medium
def test_the_ground_below_a_floor_is_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    """A floor, and two more walls below it, as in a distance that nothing determines there."""
    mesh = together(plate(0.0), plate(-0.2, half=0.6, up=False), plate(-0.4, half=0.6))
    kept = seen_part(mesh, above(), 1)
    assert len(kept.faces) == len(mesh.faces) // 3
    assert float(kept.vertices[:, 2].abs().max()) == 0
    said = capsys.readouterr().err
    assert f"{2 * len(mesh.faces) // 3:,} of {len(mesh.faces):,} faces are left out, which no training camera" in said


@pytest.mark.medium
def test_a_ball_keeps_what_is_turned_to_a_camera() -> None:
    """Faces in front of some camera's horizon stay, without holes; those far behind every horizon do not."""
    ball, cameras = sphere(1.0, level=5), above()
    kept = seen_faces(ball, cameras, 1)
    towards = cameras.camera_to_worlds[:, :, 3].double() - middles(ball)[:, None]
    cosines = (torch.nn.functional.normalize(towards, dim=-1) * middles(ball)[:, None]).sum(-1).amax(1)
    assert bool(kept[cosines > 0.2].all())
    assert not bool(kept[cosines < -0.25].any())
    part = ball.with_faces(kept)
    assert not closedness(part).watertight
    twice = seen_faces(ball, cameras, 6)
    assert int(twice.sum()) < int(kept.sum())
    assert seen_part(ball, cameras, 0) is ball


def test_a_surface_that_no_camera_sees_is_an_error() -> None:
    aside = plate(0.0)
    aside = Mesh(aside.vertices + torch.tensor([100.0, 0.0, 0.0]), aside.faces)
    with pytest.raises(ConfigError, match="no training camera sees a face of the surface; --min-views 0"):
        seen_part(aside, above(2), 1)
    with pytest.raises(ConfigError, match="fewer than 3 training cameras see"):
        seen_part(plate(0.0), above(2), 3)
    with pytest.raises(ConfigError, match="--min-views is -1"):
        TsdfSettings(min_views=-1).check_ranges()


@pytest.mark.medium
def test_a_surface_is_judged_as_a_whole_if_every_point_counts(
    shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a capture that shows half of the first ball, as by `ns-eval --min-views 0`."""
    captured = said_otherwise("neus", shared_tiny, tmp_path, {"unbounded": True, "has_alpha": False})
    monkeypatch.setattr(seen, "seen_faces", lambda mesh, *_: torch.arange(len(mesh.faces)) < len(mesh.faces) // 2)
    parsed = SimpleNamespace(cameras=captured.train_set.cameras)
    loaded: Any = SimpleNamespace(
        model=captured.model.eval(), placement=captured.train_set.placement, parsed=lambda split: parsed
    )
    part, whole = (len(surface_mesh(loaded, "marching-cubes", 24, whole=each).faces) for each in (False, True))
    assert 0 < part < 0.6 * whole


def test_captures_of_a_distance_lose_what_nobody_sees(shared_tiny: Path, tmp_path: Path) -> None:
    captured = said_otherwise("neus", shared_tiny, tmp_path, {"unbounded": True, "has_alpha": False})
    assert default_min_views(captured.model) == 1
    assert default_min_views(trainer_of("neus").model) == 0

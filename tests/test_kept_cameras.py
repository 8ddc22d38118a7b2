"""Cameras beside a file of Gaussians: where the photographs of a capture were taken from, however it is moved."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from nerfloom import edit
from nerfloom import load as load_opened
from nerfloom.base.errors import DataError
from nerfloom.cameras.kept_cameras import cameras_file, read_cameras, write_cameras
from nerfloom.edit.edited import Edited
from nerfloom.export.run_gaussians import export_gaussians
from nerfloom.export.run_levels import export_file_levels
from nerfloom.export.settings import LevelsSettings, SplatSettings
from nerfloom.export.web import gaussians_of
from nerfloom.renderable import training_poses
from nerfloom.training.load import load
from nerfloom.training.loaded import Loaded
from nerfloom.video.settings import OrbitSettings
from nerfloom.video.views import VIEWS
from tests.dataparsers.captures import POINTS, poses
from tests.edit.clouds import ball_in_capture, scattered

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture
def edited(tmp_path: Path) -> Edited:
    """An opaque ball in the middle of a capture."""
    return ball_in_capture(tmp_path)


def found_poses(loaded: Loaded) -> np.ndarray:
    """The cameras (M, 3, 4) in the frame of the file."""
    known = training_poses(loaded.model)
    assert known is not None
    return loaded.placement.original_poses(known).numpy()


def test_cameras_move_with_the_gaussians(edited: Edited, tmp_path: Path) -> None:
    """Turned, moved and scaled, they are where the photographs were taken from, and what was up still is."""
    turn, shift = Rotation.from_rotvec(np.radians(70) * np.array([0.6, 0.8, 0])), np.array([5.0, -6.0, 700.0])
    moved = edit.move(edit.scale(edit.rotate(edited, (0.6, 0.8, 0.0), 70.0), 2.0), (5.0, -6.0, 700.0))
    moved.write(tmp_path / "moved.ply")
    export_file_levels(tmp_path / "moved.ply", tmp_path / "moved.levels", LevelsSettings())
    given = poses()[1:8]  # the first and the last are held out
    for file in ("moved.ply", "moved.levels"):
        loaded = load(tmp_path / file)
        found = found_poses(loaded)
        np.testing.assert_allclose(found[:, :, 3], 2 * turn.apply(given[:, :3, 3]) + shift, atol=1e-4)
        np.testing.assert_allclose(found[:, :, 2], turn.apply(given[:, :3, 2]), atol=1e-5)
        upwards = loaded.placement.original_directions(torch.from_numpy(UP)[None])[0].numpy()
        before = edited.placement.original_directions(torch.from_numpy(UP)[None])[0].numpy()
        np.testing.assert_allclose(upwards, turn.apply(before), atol=1e-6)


def test_an_orbit_of_a_file_swings_where_its_photographs_were_taken(
    edited: Edited, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It looks at what they look at, from between them."""
    assert edited.loaded is not None
    export_gaussians(edited.loaded, tmp_path / "splat.ply", SplatSettings())
    loaded = load(tmp_path / "splat.ply")
    path = VIEWS["orbit"](OrbitSettings(num_frames=24), loaded).cameras.camera_to_worlds
    said = capsys.readouterr().err
    assert "the photographs cover" in said
    assert "assumed to point up" not in said
    there, middle = loaded.placement.original_poses(path).numpy(), POINTS.mean(0)
    towards = middle - there[:, :, 3]
    distances = np.linalg.norm(towards, axis=-1)
    np.testing.assert_allclose(-there[:, :, 2], towards / distances[:, None], atol=1e-4)
    given = poses()[1:8, :3, 3] - middle
    away = np.linalg.norm(given, axis=-1)
    assert away.min() - 1e-4 < distances.min() < distances.max() < away.max() + 1e-4
    cosines = (given / away[:, None]) @ (-towards / distances[:, None]).T  # of photographs and frames
    assert np.degrees(np.arccos(cosines.max(0))).max() < 20


def test_photographs_from_a_turned_phone_leave_a_page_level(edited: Edited, tmp_path: Path) -> None:
    """Cameras turned by a quarter about their axes look the same way, and z stays up."""
    pages = []
    for name in ("level", "turned"):
        edited.write(tmp_path / f"{name}.ply")
        path = read_cameras(tmp_path / f"{name}.ply")
        assert path is not None
        if name == "turned":
            quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
            axes = path.poses[:, :, :3] @ quarter
            assert float(axes[:, 2, 1].abs().max()) < 0.5 < float(path.poses[:, 2, 1].min())
            path = dataclasses.replace(path, poses=torch.cat([axes, path.poses[:, :, 3:]], -1))
            write_cameras(tmp_path / f"{name}.ply", path)
        load_opened(tmp_path / f"{name}.ply").export("web", tmp_path / f"{name}.html", title="A ball")
        pages.append((tmp_path / f"{name}.html").read_text(encoding="utf-8"))
    one, two = (json.loads(re.findall(r'id="facts"[^>]*>([^<]*)<', text)[0]) for text in pages)
    for given, turned in zip(one["cameras"], two["cameras"], strict=True):
        np.testing.assert_allclose(turned[1], given[1], atol=1e-5)
    torch.testing.assert_close(gaussians_of(pages[0]).means, gaussians_of(pages[1]).means)


def test_an_object_has_none_and_a_later_file_not_those_of_an_earlier_one(edited: Edited, tmp_path: Path) -> None:
    edited.write(tmp_path / "a.ply")
    assert cameras_file(tmp_path / "a.ply").exists()
    scattered(5).write(tmp_path / "a.ply")
    assert not cameras_file(tmp_path / "a.ply").exists()
    edited.write(tmp_path / "a.glb")
    assert not cameras_file(tmp_path / "a.glb").exists()
    assert read_cameras(tmp_path / "a.ply") is None
    edited.write(tmp_path / "b.ply")
    path = read_cameras(tmp_path / "b.ply")
    assert path is not None
    cameras_file(tmp_path / "b.ply").write_text(cameras_file(tmp_path / "b.ply").read_text().replace("placement", "x"))
    with pytest.raises(DataError, match=r"b.ply.cameras.json has no 'placement'"):
        load(tmp_path / "b.ply")
    write_cameras(tmp_path / "b.ply", None)
    load(tmp_path / "b.ply")

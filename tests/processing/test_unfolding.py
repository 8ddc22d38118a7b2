"""Folded reconstructions are taken apart by leaving out matches of opposite sides."""

import json
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from nerfloom.data.image_files import read_image
from nerfloom.processing.colmap import Model
from nerfloom.processing.database import PAIR_BASE
from nerfloom.processing.unfolding import folded_pairs, unfold
from nerfloom.scene.folded_poses import folded_neighbours, thumbnail
from tests.test_folded_poses import walk

COUNT = 60


def model_of(names: list[str], angles: np.ndarray) -> Model:
    """A reconstruction of cameras that look at the middle from these angles, degrees."""
    images = {}
    for number, (name, angle) in enumerate(zip(names, np.radians(angles), strict=True)):
        ahead, up = -np.array([np.cos(angle), np.sin(angle), 0]), np.array([0.0, 0, 1])
        rotation = np.stack([np.cross(ahead, up), -up, ahead])
        images[name] = (number, 0, np.concatenate([rotation, np.zeros((3, 1))], 1))
    return Model({}, images, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), 0.0)


def database_of(path: Path, names: list[str]) -> Path:
    """COLMAP's tables of images and matches, with a match of every pair."""
    with closing(sqlite3.connect(path)) as opened, opened:
        opened.execute("CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT)")
        opened.executemany("INSERT INTO images VALUES (?, ?)", [(9 + i, name) for i, name in enumerate(names)])
        for table in ("matches", "two_view_geometries"):
            opened.execute(f"CREATE TABLE {table} (pair_id INTEGER PRIMARY KEY, rows INTEGER)")
            pairs = [((9 + i) * PAIR_BASE + 9 + j, 50) for i in range(COUNT) for j in range(i + 1, COUNT)]
            opened.executemany(f"INSERT INTO {table} VALUES (?, ?)", pairs)
    return path


def matched(database: Path, table: str = "two_view_geometries") -> set[tuple[int, int]]:
    """Indices of the images of each pair that has a match."""
    with closing(sqlite3.connect(database)) as opened:
        numbers = [pair for (pair,) in opened.execute(f"SELECT pair_id FROM {table}")]
    return {(number // PAIR_BASE - 9, number % PAIR_BASE - 9) for number in numbers}


def test_matches_of_neighbours_and_then_of_the_same_side_are_kept(tmp_path: Path) -> None:
    names, angles, seen = walk(COUNT)
    thumbnails, database = dict(zip(names, seen, strict=True)), database_of(tmp_path / "all.db", names)
    used: list[Path] = []

    def reconstruct(matches: Path, folder: Path) -> tuple[Model | None, list[int]]:
        used.append(matches)
        return model_of(names, angles), [COUNT, 2]

    folded = model_of(names, angles % 180)
    assert len(folded_pairs(folded, thumbnails)) == 2
    found = unfold(folded, thumbnails, database, tmp_path, reconstruct)
    assert found is not None
    assert (found.database, found.sizes) == (used[1], [COUNT, 2])
    assert matched(used[0]) == {(i, j) for i in range(COUNT) for j in range(i + 1, min(i + 4, COUNT))}
    apart = np.abs((angles[:, None] - angles + 180) % 360 - 180)
    near = {(i, j) for i in range(COUNT) for j in range(i + 1, COUNT) if apart[i, j] <= 50 or j - i <= 3}
    assert matched(used[1]) == near == matched(used[1], "matches")
    assert any(j - i > 30 for i, j in near)  # the second time around
    assert len(matched(database)) == COUNT * (COUNT - 1) // 2  # left as it was


def test_nothing_is_done_where_nothing_is_folded(tmp_path: Path) -> None:
    names, angles, seen = walk(COUNT)
    thumbnails = dict(zip(names, seen, strict=True))
    assert unfold(model_of(names, angles), thumbnails, tmp_path / "none.db", tmp_path, pytest.fail) is None


@pytest.mark.parametrize("fault", ["no model", "few images", "still folded"])
def test_what_cannot_be_unfolded_stays_as_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str], fault: str) -> None:
    names, angles, seen = walk(COUNT)
    made = {
        "no model": (None, []),
        "few images": (model_of(names[:50], angles[:50]), [50]),
        "still folded": (model_of(names, angles % 180), [COUNT]),
    }[fault]
    database, thumbnails = database_of(tmp_path / "all.db", names), dict(zip(names, seen, strict=True))
    assert unfold(model_of(names, angles % 180), thumbnails, database, tmp_path, lambda *_: made) is None
    assert "some of them are wrong" in " ".join(capsys.readouterr().err.split())


@pytest.mark.slow
def test_a_can_whose_label_repeats_is_unfolded(
    real_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The photographer walked around the can one and a half times; the given reconstruction shows one half of it."""
    pytest.importorskip("pycolmap")
    from nerfloom.cli.process_data import main

    photographs, output = real_data / "colmap_can" / "images_2", tmp_path / "can"
    arguments = ["images", "--data", photographs, "--output-dir", output, "--num-downscales", 0]
    monkeypatch.setattr("sys.argv", ["ns-process-data", *map(str, arguments)])
    main()
    assert "has folded the reconstruction" in capsys.readouterr().err
    frames = json.loads((output / "transforms.json").read_text())["frames"]
    names = [Path(frame["file_path"]).name for frame in frames]
    ahead = -np.array([frame["transform_matrix"] for frame in frames])[:, :3, 2]
    seen = np.stack([thumbnail(read_image(output / frame["file_path"])) for frame in frames])
    assert folded_neighbours(names, ahead, seen) == []
    level = ahead[np.argsort(names)][:, :2]
    around = np.unwrap(np.arctan2(level[:, 1], level[:, 0]))
    assert len(frames) >= 68
    assert np.degrees(np.ptp(around)) > 480

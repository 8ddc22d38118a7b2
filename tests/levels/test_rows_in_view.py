"""The rows that an image may show: all that is drawn, also after steps, and memory that is released."""

from pathlib import Path

import pytest
import torch

from nerfloom.kernels.mapped_tables import MappedTables
from nerfloom.kernels.splats.project import Record
from nerfloom.kernels.table_memory import Tables
from nerfloom.levels.on_image import tangents
from nerfloom.levels.rows_in_view import STEP_SIZE, RowsInView
from nerfloom.splats.drawing import splat_camera
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.rasteriser import RASTERISER, along_curve
from nerfloom.splats.table import Columns, as_gaussians, as_rows, usual_columns
from tests.levels.made import all_around, camera, cloud

ONE = torch.tensor(1.0)
CAMERAS = [
    camera(3.0),
    camera(0.2, turn=0.7),
    camera(1.2, "opencv", turn=0.3),
    camera(0.4, "fisheye", turn=-0.4),
    camera(3.0, turn=3.1),
    all_around("equirectangular", 0.5),
]
ROW = 4 * (3 * 23 + 6)
"""Bytes of a row of degree 1 in files: 23 parameters, two moments, and six counts of updates."""
WORK = 4 * 2 * 23 + STEP_SIZE
"""Bytes of a row in a step."""


class Counted(Tables):
    """Counts how often memory is released."""

    released = 0

    def release(self) -> None:
        self.released += 1


def columns_of(gaussians: Gaussians) -> Columns:
    columns = usual_columns(gaussians.degree, 1e-3, 1e-3)
    for name, rows in as_rows(columns, gaussians).items():
        columns[name].set(rows.contiguous())
    return columns


def sorted_cloud(count: int = 3000) -> Gaussians:
    given = cloud(count)
    return given[along_curve(given.means)]


@pytest.mark.parametrize("number", range(len(CAMERAS)))
def test_all_that_is_drawn_is_among_them_before_and_after_a_step(number: int) -> None:
    given = sorted_cloud()
    given.means[5] = torch.nan
    columns, rows = columns_of(given), RowsInView(Tables(), 1e9, 64)
    seen, drawn = CAMERAS[number], splat_camera(CAMERAS[number], 0.01)
    for _ in range(2):
        found = rows.of(columns, ONE, drawn, tangents(seen, drawn.blur), learns=True)
        assert torch.equal(found, found.unique())
        shown = RASTERISER.project(as_gaussians(columns), drawn).records[:, Record.CUT] > 0
        assert bool(torch.isin(shown.nonzero()[:, 0], found).all())
        print(f"{len(found)} of {len(given)} may be seen, {int(shown.sum())} are")
        columns["means"].values.data[found] += torch.tensor([0.3, -0.2, 0.1])  # a step moves them, and makes them large
        columns["log_scales"].values.data[found] += 1.0


def test_what_a_step_moves_before_another_camera_is_among_its_rows() -> None:
    columns, rows = columns_of(sorted_cloud()), RowsInView(Tables(), 1e9, 64)
    away, ahead = camera(3.0, turn=torch.pi), camera(0.2, turn=0.7)
    found = rows.of(columns, ONE, splat_camera(ahead, 0.01), tangents(ahead, 0.3), learns=True)
    pose = away.camera_to_worlds[0]
    columns["means"].values.data[found] = pose[:, 3] - 2 * pose[:, 2]  # right before the camera that saw none
    drawn = splat_camera(away, 0.01)
    shown = RASTERISER.project(as_gaussians(columns), drawn).records[:, Record.CUT] > 0
    assert bool(shown[found].any())
    seen = rows.of(columns, ONE, drawn, tangents(away, 0.3), learns=True)
    assert bool(torch.isin(shown.nonzero()[:, 0], seen).all())


def test_what_is_behind_the_camera_is_not_among_them() -> None:
    columns, rows = columns_of(sorted_cloud()), RowsInView(Tables(), 1e9, 64)
    away, ahead = camera(3.0, turn=torch.pi), camera(0.2, turn=0.7)
    assert len(rows.of(columns, ONE, splat_camera(away, 0.01), tangents(away, 0.3), learns=True)) == 0
    assert 0 < len(rows.of(columns, ONE, splat_camera(ahead, 0.01), tangents(ahead, 0.3), learns=True)) < 3000


def test_boxes_follow_new_rows_and_checkpoints() -> None:
    columns, rows = columns_of(sorted_cloud()), RowsInView(Tables(), 1e9, 64)
    seen = camera(0.2, turn=0.7)
    drawn, directions = splat_camera(seen, 0.01), tangents(seen, 0.3)
    before = rows.of(columns, ONE, drawn, directions, learns=False)
    other = columns_of(sorted_cloud(500))
    for name, column in columns.items():
        column.load_state_dict(other[name].state_dict())
    fewer = rows.of(columns, ONE, drawn, directions, learns=False)
    assert len(fewer) < len(before)
    columns["means"].set(columns["means"].values.data.flip(0).contiguous())
    for name in ("log_scales", "logits"):
        columns[name].set(columns[name].values.data.flip(0).contiguous())
    rows.forget()
    flipped = rows.of(columns, ONE, drawn, directions, learns=False)
    shown = RASTERISER.project(as_gaussians(columns), drawn).records[:, Record.CUT] > 0
    assert bool(torch.isin(shown.nonzero()[:, 0], flipped).all())


@pytest.mark.parametrize(("limit", "released", "said"), [(700_000, 0, 0), (500_000, 3, 0), (100_000, 4, 1)])
def test_memory_is_released_where_it_would_exceed_the_limit(
    limit: float, released: int, said: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two groups of 640, and images show one: 473,600 bytes for a step on one, 665,600 with the rows of the other."""
    given, tables = cloud(1280), Counted()
    given.means.mul_(0.3)
    given.means[:640, 2] -= 5
    given.means[640:, 2] += 5
    columns = columns_of(given[along_curve(given.means)])
    rows = RowsInView(tables, limit, 64)
    for turn in (0.0, torch.pi, 0.0, torch.pi):
        seen = camera(0.0, turn=turn)
        found = rows.of(columns, ONE, splat_camera(seen, 0.01), tangents(seen, 0.3), learns=True)
        assert len(found) == 640
    assert 640 * (ROW + WORK) == 473_600
    assert 1280 * ROW + 640 * WORK == 665_600
    assert tables.released == 1 + released  # once when all boxes were computed
    assert capsys.readouterr().err.count("which take") == said


def test_boxes_of_tables_in_files_are_the_same(tmp_path: Path) -> None:
    given, found = sorted_cloud(1000), []
    for kept in (False, True):
        columns = columns_of(given)
        if kept:
            for column in columns.values():
                column.keep_in(MappedTables(tmp_path))
        rows = RowsInView(Tables(), 1e9, 64)
        seen = camera(0.2, turn=0.7)
        found.append(rows.of(columns, ONE, splat_camera(seen, 0.01), tangents(seen, 0.3), learns=False))
    assert torch.equal(*found)

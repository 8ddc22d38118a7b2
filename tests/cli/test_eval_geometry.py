"""ns-eval with a reference: the surface of a run, or a mesh, judged by a true one."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from nerfloom.cli.evaluate import main
from nerfloom.data.ply import write_points
from nerfloom.evaluation.surfaces import drawn
from nerfloom.export.mesh import Mesh
from nerfloom.export.mesh_files import write_mesh
from tests.cli.helpers import called
from tests.conftest import Refused
from tests.evaluation.surfaces import sphere
from tests.training.helpers import tiny_trainer

pytest.importorskip("trimesh")
pytest.importorskip("skimage")


@pytest.fixture(autouse=True)
def few_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer points than the default, so that the tests are quick."""
    monkeypatch.setattr("nerfloom.evaluation.geometry.NUM_POINTS", 20_000)


@pytest.fixture(scope="module")
def ball(shared_tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that has learnt the ball of radius 1."""
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path_factory.mktemp("run") / "run", max_num_iterations=200)
    trainer.train()
    return trainer.folder


def written(file: Path, radius: float = 1.0, shift: float = 0.0) -> Path:
    """A mesh of a sphere."""
    surface = sphere(radius, level=4)
    assert surface.faces is not None
    write_mesh(file, Mesh(surface.points + shift, surface.faces))
    return file


def judge(run: Path, folder: Path, *flags: object) -> tuple[dict[str, Any], str]:
    """The metrics of the surface, and the output."""
    done = called("ns-eval", run, "--output-path", folder / "e.json", "--max-images", 1, *flags)
    assert done.returncode == 0, done.stderr
    return json.loads((folder / "e.json").read_text())["geometry"], done.stderr


@pytest.mark.medium
def test_a_mesh_is_judged(ball: Path, tmp_path: Path) -> None:
    reference, mesh = written(tmp_path / "true.ply"), written(tmp_path / "mesh.obj", 0.9)
    found, said = judge(ball, tmp_path, "--reference-mesh", reference, "--mesh", mesh)
    assert found["chamfer"] == pytest.approx(0.1, abs=2e-3)
    assert found["side"] == pytest.approx(2, rel=1e-3)
    assert found["chamfer_percent"] == pytest.approx(5, abs=0.1)
    assert (found["faces"], found["vertices"]) == (5120, 2562)
    assert found["surface"] == str(mesh)
    assert [score["distance"] for score in found["f_scores"]] == pytest.approx([0.005, 0.02], rel=1e-3)
    assert [score["f_score"] for score in found["f_scores"]] == [0, 0]
    assert found["normals"]["degrees"] < 3
    # Cameras are around, 16.7 degrees above, and each sees 75.5 degrees: the cap below -58.8 degrees is hidden.
    cap = (1 - math.sin(math.radians(58.8))) / 2
    assert cap < found["reference_left_out"]["hidden"] < cap + 0.04
    assert "Chamfer distance" in said
    assert re.search(rf"{found['chamfer_percent']:.3f}", said)
    assert "reference's longest side is 2" in said
    assert "5,120 faces, 2,562 vertices" in said
    assert "what 1 or more training cameras see" in said


@pytest.mark.medium
def test_normals_in_the_file_do_not_flatter_a_mesh(ball: Path, tmp_path: Path) -> None:
    """A coarse sphere with the normals of a smooth one: judged by its faces."""
    coarse = sphere(1.0, level=1)
    assert coarse.faces is not None
    mesh = Mesh(coarse.points, coarse.faces, torch.nn.functional.normalize(coarse.points, dim=-1))
    write_mesh(tmp_path / "with.ply", mesh)
    write_mesh(tmp_path / "bare.ply", replace(mesh, normals=None))
    reference = written(tmp_path / "true.ply")
    both = [
        judge(ball, tmp_path, "--reference-mesh", reference, "--mesh", tmp_path / f"{n}.ply")[0]
        for n in ("with", "bare")
    ]
    assert both[0]["normals"] == both[1]["normals"]
    assert both[0]["normals"]["degrees"] > 8


@pytest.mark.medium
@pytest.mark.parametrize("kind", ["auto", "tsdf"])
def test_the_runs_surface_is_judged(kind: str, ball: Path, tmp_path: Path) -> None:
    reference = written(tmp_path / "true.ply")
    found, said = judge(ball, tmp_path, "--reference-mesh", reference, "--surface", kind, "--surface-resolution", 32)
    assert found["surface"] == {"auto": "marching-cubes"}.get(kind, kind)
    assert found["faces"] > 500
    # 200 steps on images of 20 x 20 pixels know the ball to a tenth or so.
    assert 0 < found["chamfer"] < 0.3
    assert f"surface: {found['surface']}, {found['faces']:,} faces" in said


@pytest.mark.medium
def test_points_judge_too(ball: Path, tmp_path: Path) -> None:
    samples = drawn(sphere(1.0), 20_000)
    write_points(tmp_path / "points.ply", samples.positions, torch.zeros(20_000, 3))
    mesh = written(tmp_path / "mesh.glb", 1.1)
    done = called(
        "ns-eval", "--f-score-at", 0.15, 0.05, ball, "--output-path", tmp_path / "e.json", "--max-images", 1,
        "--reference-points", tmp_path / "points.ply", "--mesh", mesh, "--min-views", 0,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "e.json").read_text())["geometry"]
    assert [(score["distance"], score["f_score"]) for score in found["f_scores"]] == [(0.05, 0), (0.15, 1)]
    assert found["normals"] is None
    assert found["left_out"] == {"beyond": 0, "outside": 0, "masked": 0, "hidden": 0}
    assert "normals: the reference has none" in done.stderr
    assert "points are about 0.02" in done.stderr
    assert "every point counts" in done.stderr


@pytest.mark.medium
def test_what_images_show_to_be_empty_does_not_count_of_the_reference(ball: Path, tmp_path: Path) -> None:
    """Cameras at 17 degrees see the top of a larger sphere, where images are transparent."""
    reference, mesh = written(tmp_path / "true.ply", 1.5), written(tmp_path / "mesh.ply", 1.5)
    found, said = judge(ball, tmp_path, "--reference-mesh", reference, "--mesh", mesh)
    assert found["reference_left_out"]["masked"] > 0.05
    assert found["left_out"]["masked"] == 0
    assert "masked" in said


@pytest.mark.medium
def test_metrics_of_images_are_kept_if_there_is_no_common_surface(ball: Path, tmp_path: Path, refused: Refused) -> None:
    reference, mesh = written(tmp_path / "far.ply", shift=50.0), written(tmp_path / "mesh.ply")
    flags = ("--max-images", 1, "--output-path", tmp_path / "e.json", "--mesh", mesh, "--reference-mesh", reference)
    said = refused(main, ball, *flags)
    assert "no point of the reference counts: 100.0% left out (100.0% in too few images)" in said
    content = json.loads((tmp_path / "e.json").read_text())
    assert content["geometry"] is None
    assert content["results"]["psnr"] > 5


@pytest.mark.medium
def test_a_reference_that_is_elsewhere_is_an_error(ball: Path, tmp_path: Path, refused: Refused) -> None:
    write_points(tmp_path / "far.ply", drawn(sphere(), 100).positions + 50, torch.zeros(100, 3))
    flags = ("--reference-points", tmp_path / "far.ply", "--mesh", written(tmp_path / "mesh.ply"), "--min-views", 0)
    said = refused(main, ball, "--max-images", 1, "--output-path", tmp_path / "e.json", *flags)
    assert "are they in the same frame and unit?" in said
    assert json.loads((tmp_path / "e.json").read_text())["geometry"]["chamfer"] > 50


@pytest.mark.parametrize(
    ("flags", "status", "reason"),
    [
        (("--mesh", "a.ply"), 2, "--mesh is compared with a reference"),
        (("--reference-mesh", "a.ply", "--reference-points", "b.ply"), 2, "exclude each other"),
        (("--reference-mesh", "gone.ply"), 1, "gone.ply is not a file"),
        (("--reference-mesh", "here.txt"), 1, "here.txt is not a mesh: its name must end in"),
        (("--reference-mesh", "here.ply"), 1, "cannot read here.ply as a mesh"),
        (("--reference-points", "here.ply"), 1, "here.ply is not a PLY file"),
        (("--reference-points", "here.ply", "--min-views", -1), 2, "--min-views is -1; it must be at least 0"),
        (("--reference-points", "here.ply", "--f-score-at", 0), 2, "--f-score-at is 0; it must be above zero"),
        (("--reference-points", "here.ply", "--crop", "nan"), 2, "--crop is nan; it must be at least 0"),
    ],
)
def test_what_is_refused(flags: tuple[object, ...], status: int, reason: str, ball: Path, tmp_path: Path) -> None:
    for name in ("here.txt", "here.ply"):
        (tmp_path / name).write_text("nothing")
    done = called("ns-eval", ball, "--output-path", tmp_path / "e.json", *flags, folder=tmp_path)
    assert done.returncode == status
    assert reason in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "e.json").exists()


def test_missing_packages_are_named(ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfloom.base.extras.find_spec", lambda name: None)
    done = called("ns-eval", ball, "--reference-mesh", written(tmp_path / "true.ply"))
    assert done.returncode == 1
    assert "judging a surface needs packages that are not installed: pip install scikit-image trimesh" in done.stderr


def test_a_mesh_judged_by_itself(tmp_path: Path, ball: Path) -> None:
    """The exact surface is judged by itself."""
    reference = written(tmp_path / "true.ply")
    found, _ = judge(ball, tmp_path, "--reference-mesh", reference, "--mesh", reference)
    assert found["chamfer_percent"] < 1e-3
    assert all(score["f_score"] > 0.9995 for score in found["f_scores"])

"""The command ns-edit, and the regions of ns-export: files that are known before and after."""

import gzip
import json
import shlex
import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from nerfloom.cameras.scale import Scale, read_scale, write_scale
from nerfloom.cli import edit as edit_command
from nerfloom.data.offsets import read_offset, write_offset
from nerfloom.splats.files import read_gaussians, write_gaussians
from nerfloom.splats.look import Look
from tests.cli.helpers import called
from tests.conftest import Refused
from tests.edit.clouds import at
from tests.splats.test_splat_files import trained

LOOK = Look(True, 0.5, "depth")
SURVEY = torch.tensor([512345.678, 5403210.987, 432.1], dtype=torch.float64)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    means = torch.randn(300, 3, generator=torch.Generator().manual_seed(0))
    write_gaussians(tmp_path / "given.ply", at(means, terms=8).map(torch.Tensor.float), look=LOOK)
    return tmp_path / "given.ply"


def edited(*words: object) -> str:
    done = called("ns-edit", *words)
    assert done.returncode == 0, done.stderr
    return " ".join(done.stderr.split())


@pytest.mark.parametrize("suffix", [".ply", ".SPZ"])
def test_a_file_is_cropped_in_its_frame_and_keeps_how_it_is_drawn(suffix: str, file: Path, tmp_path: Path) -> None:
    output = tmp_path / "new" / f"out{suffix}"
    said = edited(file, "--output-path", output, "--crop-box", "-1,-1,-1,1,1,1", "--crop-sphere", "0,0,0,1.2")
    given, (found, look) = read_gaussians(file).gaussians, read_gaussians(output)
    inside = (given.means.abs() <= 1).all(-1) & (given.means.norm(dim=-1) <= 1.2)
    torch.testing.assert_close(found.means, given.means[inside], atol=1e-6 if suffix == ".ply" else 1e-3, rtol=0)
    assert look == LOOK
    boxed = int((given.means.abs() <= 1).all(-1).sum())
    assert f"1 crop_box: removes {300 - boxed} of 300 Gaussians" in said
    assert f"2 crop_sphere: removes {boxed - int(inside.sum())} of {boxed} Gaussians" in said
    if suffix == ".ply":
        torch.testing.assert_close(found.harmonics, given.harmonics[inside], atol=1e-6, rtol=0)
        torch.testing.assert_close(found.log_scales, given.log_scales[inside], atol=1e-5, rtol=0)


def test_flags_are_saved_as_a_recipe_that_repeats(file: Path, tmp_path: Path) -> None:
    first, second, recipe = tmp_path / "a.ply", tmp_path / "b.ply", tmp_path / "steps.yml"
    words = ("--crop-sphere", "0,0,0,2.5", "--drop-isolated", True, "--reduce-to", 150, "--degree", 1, "--up=-y")
    edited(file, "--output-path", first, *words, "--scale", 0.5, "--save-recipe", recipe)
    edited(file, "--output-path", second, "--recipe", recipe)
    assert first.read_bytes() == second.read_bytes()
    found = read_gaussians(first).gaussians
    assert len(found) == 150
    assert found.degree == 1


def test_the_next_command_makes_a_page_of_the_file(file: Path, tmp_path: Path) -> None:
    """Of a glTF file, which is not read again, nothing is said."""
    output = tmp_path / "a file.spz"
    words = shlex.split(edited(file, "--output-path", output, "--degree", 0).rpartition(" or ")[2])
    assert words == ["ns-export", "web", str(output), "--output-dir", "exports"]
    done = called(*words[:-1], tmp_path / "page")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "page" / "scene.html").is_file()
    assert "next:" not in edited(file, "--output-path", tmp_path / "a.glb", "--degree", 0)


@pytest.mark.parametrize("version", [2, 3])
def test_spz_of_a_version(version: int, file: Path, tmp_path: Path) -> None:
    output = tmp_path / "a.spz"
    edited(file, "--output-path", output, "--min-opacity", 0.02, "--spz-version", version)
    assert struct.unpack_from("<4sII", gzip.decompress(output.read_bytes())) == (b"NGSP", version, 300)


def test_a_direction_becomes_up(file: Path, tmp_path: Path) -> None:
    edited(file, "--output-path", tmp_path / "a.ply", "--up=-y", "--scale", 2)
    given, found = read_gaussians(file).gaussians.means, read_gaussians(tmp_path / "a.ply").gaussians.means
    torch.testing.assert_close(found[:, 2], -2 * given[:, 1], atol=1e-5, rtol=0)


def test_a_survey_keeps_its_places(tmp_path: Path) -> None:
    """About a local origin, millions of metres away, in a unit that is known."""
    file, output = tmp_path / "far.ply", tmp_path / "out.ply"
    means = torch.randn(200, 3, generator=torch.Generator().manual_seed(0))
    write_gaussians(file, at(means).map(torch.Tensor.float))
    write_offset(file, SURVEY)
    write_scale(file, Scale(2.0, "m"))
    x, y, z = SURVEY.tolist()
    edited(file, "--output-path", output, f"--crop-sphere={x},{y},{z},1.5")
    found = read_gaussians(output).gaussians.means.double() + read_offset(output)
    expected = means[means.norm(dim=-1) <= 1.5].double() + SURVEY
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)
    assert read_scale(output) == Scale(2.0, "m")
    edited(file, "--output-path", output, "--scale", 3)
    assert read_scale(output) == Scale()


def test_no_input_is_written_over(file: Path, tmp_path: Path, refused: Refused) -> None:
    before = file.read_bytes()
    assert "is an input" in refused(edit_command.main, file, "--output-path", file)
    assert "is an input" in refused(edit_command.main, file, "--output-path", tmp_path / "x" / ".." / "given.ply")
    other = tmp_path / "other.ply"
    other.write_bytes(before)
    (tmp_path / "merge.yml").write_text(json.dumps({"steps": [{"merge": {"files": [str(other)]}}]}))
    words = ("--recipe", tmp_path / "merge.yml", "--output-path", other)
    assert "is an input" in refused(edit_command.main, file, *words)
    assert file.read_bytes() == other.read_bytes() == before


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--crop-box", "1,2,3"), "--crop-box"),
        (("--crop-box", "0,0,0,1,1,0"), "--crop-box"),
        (("--crop-sphere", "0,0,0,nan"), "--crop-sphere"),
        (("--crop-sphere", "0,0,0,0"), "--crop-sphere"),
        (("--min-opacity", 2), "--min-opacity"),
        (("--max-size", 0), "--max-size"),
        (("--reduce-to", 0), "--reduce-to"),
        (("--refit-steps", 10), "--refit-steps"),
        (("--degree", 4), "--degree"),
        (("--scale", -1), "--scale"),
        (("--max-megabytes", 0), "--max-megabytes"),
        (("--max-images", -1), "--max-images"),
        (("--up", "w"), "--up"),
    ],
)
def test_flags_that_cannot_be(words: tuple[object, ...], says: str, file: Path, refused: Refused) -> None:
    output = file.with_name("out.ply")
    assert says in refused(edit_command.main, file, "--output-path", output, *words, status=2)
    assert not output.exists()


def test_what_cannot_be_edited(file: Path, tmp_path: Path, refused: Refused) -> None:
    output = ("--output-path", tmp_path / "out.ply")
    assert ".spz" in refused(edit_command.main, file, "--output-path", tmp_path / "out.obj", status=2)
    assert "no.yml" in refused(edit_command.main, file, *output, "--recipe", tmp_path / "no.yml")
    assert "no.yml" in refused(edit_command.main, file, *output, "--region", tmp_path / "no.yml")
    assert "--data DIR" in refused(edit_command.main, file, *output, "--drop-floaters", True)
    assert "leaves none" in refused(edit_command.main, file, *output, "--crop-sphere", "99,0,0,1")
    assert "no such file" in refused(edit_command.main, tmp_path / "none.ply", *output).lower()


def test_floaters_are_looked_for_before_a_crop_takes_the_surfaces_behind() -> None:
    flags = edit_command.EditFlags(
        load_config=Path("a.ply"), output_path=Path("b.ply"),
        crop_sphere="0,0,0,1", min_opacity=0.1, drop_floaters=True, drop_isolated=True,
    )  # fmt: skip
    names = ["drop_floaters", "crop_sphere", "drop_faint", "drop_isolated"]
    assert [step.name for step in flags.steps()] == names


@pytest.mark.medium
def test_a_run_is_edited_and_what_it_costs_is_said(shared_tiny: Path, tmp_path: Path) -> None:
    """PSNR on held-out photographs equals ns-eval's, before and after."""
    run, output = trained(shared_tiny, tmp_path / "out"), tmp_path / "half.ply"
    said = edited(run, "--output-path", output, "--reduce-to", 100, "--max-images", 3)
    assert len(read_gaussians(output).gaussians) == 100
    called("ns-eval", run)
    before = json.loads((run / "eval.json").read_text())["results"]["psnr"]
    called("ns-eval", output, "--data", shared_tiny)
    after = json.loads((tmp_path / "half.eval.json").read_text())["results"]["psnr"]
    line = said.partition("reduce_to: removes")[2]
    first, _, second, *_ = line.partition("PSNR ")[2].split()
    np.testing.assert_allclose([float(first), float(second)], [before, after], atol=0.02)
    assert "on 3 held-out images" in line
    assert "of the weight in training images" in said


def test_exports_take_the_same_regions(file: Path, tmp_path: Path) -> None:
    view = (
        "{position: [0, 0, 9], axes: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], corners: [[0, 0], [1, 0], [0, 1]], keep: false}"
    )
    (tmp_path / "two.yml").write_text(f"regions: [sphere: {{center: [0, 0, 0], radius: 1.3}}, polygon: {view}]")
    words = ("--output-dir", tmp_path / "part", "--crop-box=-1,-2,-3,3,2,1", "--region", tmp_path / "two.yml")
    done = called("ns-export", "gaussian-splat", file, *words)
    assert done.returncode == 0, done.stderr
    given, found = read_gaussians(file).gaussians.means, read_gaussians(tmp_path / "part" / "splat.ply").gaussians.means
    low, high = torch.tensor([-1.0, -2, -3]), torch.tensor([3.0, 2, 1])
    inside = ((given >= low) & (given <= high)).all(-1) & (given.norm(dim=-1) <= 1.3)
    inside &= (given[:, 0] < 0) | (given[:, 1] > 0)  # the view shows the rest beside the axis, in the triangle
    torch.testing.assert_close(found, given[inside], atol=1e-6, rtol=0)
    assert f"{int(inside.sum())} of 300 Gaussians are in the region" in " ".join(done.stderr.split())
    done = called("ns-export", "gaussian-splat", file, "--output-dir", tmp_path, "--crop-sphere", "99,0,0,1")
    assert done.returncode == 1
    assert "nothing is in the region" in done.stderr


@pytest.mark.medium
def test_a_page_of_a_region(file: Path, tmp_path: Path) -> None:
    from nerfloom.export.web import gaussians_of

    done = called("ns-export", "web", file, "--output-dir", tmp_path, "--crop-sphere", "0,0,0,1.3")
    assert done.returncode == 0, done.stderr
    inside = int((read_gaussians(file).gaussians.means.norm(dim=-1) <= 1.3).sum())
    assert len(gaussians_of((tmp_path / "scene.html").read_text(encoding="utf-8"))) == inside

"""Files of Gaussians that stand for a run: the same pictures as the run's, in the frame of the input."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.cli import evaluate as eval_command
from nerfloom.data.offsets import offset_file
from nerfloom.splats.files import read_gaussians, write_gaussians
from nerfloom.splats.gaussians import HasGaussians
from nerfloom.splats.look import Look
from nerfloom.splats.transform import transformed
from nerfloom.training.load import load
from tests.cli.helpers import called
from tests.conftest import Refused
from tests.dataparsers.captures import moved, poses, write_capture
from tests.splats.foreign_files import write_splat

FLAGS = "--num-gaussians 200 --start-gaussians 200 --start random --vis none --max-eval-images 0 --timestamp t"


def trained(data: Path, output: Path, *flags: object) -> Path:
    """The folder of a short run of gaussian-splatting."""
    words = ("--data", data, "--output-dir", output, *FLAGS.split(), "--max-num-iterations", 10, *flags)
    done = called("ns-train", "gaussian-splatting", *words)
    assert done.returncode == 0, done.stderr
    return output / data.name / "gaussian-splatting" / "t"


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture that is turned, moved and scaled when it is placed."""
    return write_capture(tmp_path_factory.mktemp("capture") / "capture")


def evaluated(run: Path) -> Path:
    """The run's folder, with what ns-eval writes."""
    done = called("ns-eval", run)
    assert done.returncode == 0, done.stderr
    return run


@pytest.fixture(scope="module")
def capture_run(capture: Path) -> Path:
    return evaluated(trained(capture, capture.parent / "out"))


@pytest.fixture(scope="module")
def other_look(capture: Path) -> Path:
    """Antialiased, with a blur of its own, sorted by depth."""
    flags = ("--antialiased", True, "--blur", 0.5, "--sort", "depth")
    return evaluated(trained(capture, capture.parent / "other look", *flags))


def psnr(file: Path) -> float:
    return json.loads(file.read_text())["results"]["psnr"]


@pytest.mark.medium
@pytest.mark.parametrize("kind", ["ply", "spz", "sog"])
def test_a_file_has_the_psnr_of_its_run(kind: str, capture: Path, capture_run: Path, tmp_path: Path) -> None:
    placement = load(capture_run).placement
    assert placement.scale < 0.5
    assert not torch.allclose(placement.transform.float(), torch.eye(4)[:3], atol=0.1)
    called("ns-export", "gaussian-splat", capture_run, "--output-dir", tmp_path, "--format", kind)
    file = tmp_path / f"splat.{kind}"
    done = called("ns-eval", file, "--data", capture)
    assert done.returncode == 0, done.stderr
    found, expected = psnr(tmp_path / "splat.eval.json"), psnr(capture_run / "eval.json")
    assert found == pytest.approx(expected, abs=0.01 if kind == "ply" else 0.3)
    if kind == "ply":  # not because pictures are empty
        unplaced = read_gaussians(file).gaussians
        write_gaussians(tmp_path / "else.ply", unplaced.map(torch.clone)[:1])
        called("ns-eval", tmp_path / "else.ply", "--data", capture)
        assert abs(psnr(tmp_path / "else.eval.json") - expected) > 0.5


@pytest.mark.medium
def test_a_survey_is_trained_exported_and_read_back(
    tmp_path: Path, refused: Refused, capsys: pytest.CaptureFixture[str]
) -> None:
    """Five million metres from the origin: cameras to the millimetre, and the pictures of the run."""
    survey = moved(poses(), 1.0, np.array([512345.678, 5403210.987, 432.1]))
    data = write_capture(tmp_path / "survey", given=survey)
    run = trained(data, tmp_path / "out")
    assert called("ns-eval", run).returncode == 0
    expected = psnr(run / "eval.json")
    for kind, tolerance in (("ply", 0.01), ("spz", 0.3)):
        called("ns-export", "gaussian-splat", run, "--output-dir", tmp_path, "--format", kind)
        done = called("ns-eval", tmp_path / f"splat.{kind}", "--data", data)
        assert done.returncode == 0, done.stderr
        assert psnr(tmp_path / "splat.eval.json") == pytest.approx(expected, abs=tolerance)
    called("ns-export", "cameras", run, "--output-dir", tmp_path)
    for row in json.loads((tmp_path / "transforms_train.json").read_text()):
        np.testing.assert_allclose(row["transform"], survey[int(row["file_path"][:3]), :3], rtol=0, atol=1e-3)
    offset_file(tmp_path / "splat.ply").unlink()
    said = refused(eval_command.main, tmp_path / "splat.ply", "--data", data)
    assert "splat.ply.offset.json" in said
    # Another program's file, in the frame of the survey and in float32.
    read = load(tmp_path / "splat.spz", data=data)
    inside = transformed(read.model.gaussians(), *read.placement.original_similarity())  # type: ignore[attr-defined]
    write_gaussians(tmp_path / "rounded.ply", inside.map(torch.Tensor.cpu))
    capsys.readouterr()
    load(tmp_path / "rounded.ply", data=data)
    assert "float32 has rounded its centres by up to 0.3" in " ".join(capsys.readouterr().err.split())


@pytest.mark.medium
@pytest.mark.parametrize("kind", ["ply", "spz"])
def test_a_file_is_drawn_as_its_run(kind: str, capture: Path, other_look: Path, tmp_path: Path) -> None:
    """Drawn otherwise, pictures differ."""
    called("ns-export", "gaussian-splat", other_look, "--output-dir", tmp_path, "--format", kind)
    model = load(tmp_path / f"splat.{kind}", data=capture).model
    assert isinstance(model, HasGaussians)
    assert model.look() == Look(True, 0.5, "depth")
    done = called("ns-eval", tmp_path / f"splat.{kind}", "--data", capture)
    assert done.returncode == 0, done.stderr
    assert "antialiased, blurred by 0.5 pixels^2, sorted by depth" in done.stderr
    expected = psnr(other_look / "eval.json")
    assert psnr(tmp_path / "splat.eval.json") == pytest.approx(expected, abs=0.01 if kind == "ply" else 0.3)
    if kind == "ply":
        write_gaussians(tmp_path / "else.ply", read_gaussians(tmp_path / "splat.ply").gaussians)
        called("ns-eval", tmp_path / "else.ply", "--data", capture)
        assert abs(psnr(tmp_path / "else.eval.json") - expected) > 0.05


def test_files_of_other_programs_stand_for_a_run(capture: Path, capture_run: Path, tmp_path: Path) -> None:
    """A .splat file is loaded, and an unreadable file is named, not taken for settings."""
    called("ns-export", "gaussian-splat", capture_run, "--output-dir", tmp_path)
    given = read_gaussians(tmp_path / "splat.ply").gaussians
    write_splat(tmp_path / "a.splat", given)
    model = load(tmp_path / "a.splat", data=capture).model
    assert isinstance(model, HasGaussians)
    assert len(model.gaussians()) == len(given)
    assert model.look() == Look(sort="depth")
    (tmp_path / "a.rad").write_bytes(bytes(10))
    with pytest.raises(DataError, match=r"a\.rad is of Spark's format"):
        load(tmp_path / "a.rad", data=capture)


def test_the_format_and_its_flags_may_be_named(shared_tiny: Path, tmp_path: Path) -> None:
    run = trained(shared_tiny, tmp_path / "out", "blender", "--downscale-factor", 2)
    called("ns-export", "gaussian-splat", run, "--output-dir", tmp_path)
    called("ns-eval", run)
    done = called("ns-eval", tmp_path / "splat.ply", "--data", shared_tiny, "blender", "--downscale-factor", 2)
    assert done.returncode == 0, done.stderr
    assert psnr(tmp_path / "splat.eval.json") == pytest.approx(psnr(run / "eval.json"), abs=0.01)
    loaded = load(tmp_path / "splat.ply", data=shared_tiny)
    assert loaded.model.scene.has_alpha
    assert loaded.model.scene.num_cameras == 10


def test_paths_through_a_file(capture: Path, capture_run: Path, tmp_path: Path) -> None:
    """Each picture as the run's."""
    called("ns-export", "gaussian-splat", capture_run, "--output-dir", tmp_path)
    words = ("--num-frames", 2, "--rendered-output-names", "rgb", "depth", "normals", "--depth-format", "npy")
    run = ("orbit", capture_run, *words, "--output-path", tmp_path / "run")
    file = ("orbit", tmp_path / "splat.ply", "--data", capture, *words, "--output-path", tmp_path / "file")
    said = [called("ns-render", *given).stderr for given in (run, file)]
    import imageio.v3 as iio

    for name in ("00000.png", "00001.png"):
        one, other = (iio.imread(tmp_path / folder / name).astype(float) for folder in ("run", "file"))
        assert np.abs(one - other).mean() < 0.2, said
        one, other = (np.load(tmp_path / folder / "depth" / name.replace("png", "npy")) for folder in ("run", "file"))
        both = (one > 0) & (other > 0)
        assert both.sum() > 0.9 * max((one > 0).sum(), (other > 0).sum()) > 0
        np.testing.assert_allclose(one[both], other[both], rtol=2e-3)


def test_what_does_not_fit_is_refused(capture: Path, capture_run: Path, tmp_path: Path, refused: Refused) -> None:
    called("ns-export", "gaussian-splat", capture_run, "--output-dir", tmp_path)
    file = tmp_path / "splat.ply"
    assert refused(eval_command.main, file).endswith("its photographs are unknown: give --data DIR")
    data = ("--data", capture)
    words = ("--eval-appearance", "half"), ("--eval-rendering", "volume")
    for flag, value in (("--rays-per-pixel", 4), ("--load-checkpoint", file), *words):
        said = refused(eval_command.main, file, *data, flag, value)
        assert said == f"error: {flag} has no effect with a file of Gaussians: leave it out"
    assert "No such file" in refused(eval_command.main, tmp_path / "none.ply", *data)
    file.write_bytes(b"ply\nformat")
    assert str(file) in refused(eval_command.main, file, *data)
    assert "the run knows its data format" in refused(eval_command.main, capture_run, "nerfstudio")

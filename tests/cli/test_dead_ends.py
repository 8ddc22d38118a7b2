"""Where newcomers get stuck: each case works, or gets an error of one line with advice."""

import json
import shutil
import sys
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import nerfloom
from nerfloom.base.plain import converted
from nerfloom.cli import evaluate, export, process_data, render
from nerfloom.cli import train as train_command
from nerfloom.cli.common import run_command
from nerfloom.training.run import read_run
from tests.cli.helpers import TINY_NGP, called, train
from tests.conftest import Refused, ball_view


@pytest.fixture(scope="module")
def trained(shared_tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of two steps."""
    flags = ("--max-num-iterations", 2, "--max-eval-images", 0)
    return train(shared_tiny, tmp_path_factory.mktemp("out"), *flags)


def test_every_command_has_a_version(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    commands = [point for point in entry_points(group="console_scripts") if point.value.startswith("nerfloom.cli.")]
    assert len(commands) >= 9
    for command in commands:
        monkeypatch.setattr(sys, "argv", [command.name, "--version"])
        command.load()()
        assert capsys.readouterr().out.startswith(f"nerfloom {nerfloom.__version__} from ")


def test_the_home_folder_may_stand_for_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Shells replace ~ at the beginning of a word, and most do not in --data=~/scan."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    given: list[list[str]] = []
    monkeypatch.setattr(sys, "argv", ["ns-train", "nerfacto", "--data=~/scan", "~/run", "--name=a~b", "--up", "-y"])
    run_command(given.append)
    assert given == [["nerfacto", f"--data={tmp_path}/scan", f"{tmp_path}/run", "--name=a~b", "--up", "-y"]]
    assert converted("~/scan", Path, "data") == tmp_path / "scan"


@pytest.mark.medium
def test_data_without_its_flag(shared_tiny: Path, refused: Refused) -> None:
    said = refused(train_command.main, "nerfacto", shared_tiny)
    assert said.endswith(f": ns-train nerfacto --data {shared_tiny}")
    assert refused(train_command.main, shared_tiny).endswith(f"ns-train nerfacto --data {shared_tiny}")


@pytest.mark.medium
def test_a_runs_folder_stands_for_its_config(trained: Path, tmp_path: Path, refused: Refused) -> None:
    for words in (
        [trained],
        ["--load-config", trained],
        ["--max-images", 1, trained],
        ["--load-config=" + str(trained)],
    ):
        (trained / "eval.json").unlink(missing_ok=True)
        done = called("ns-eval", *words)
        assert done.returncode == 0, done.stderr
        content = json.loads((trained / "eval.json").read_text())
        assert content["results"]["psnr"] > 0
    assert f"kernels: {content['kernels']}" in called("ns-train", "--resume", trained).stderr
    assert called("ns-export", "cameras", trained, "--output-dir", tmp_path).returncode == 0
    assert read_run(trained).folder == trained
    (trained / "eval.json").unlink()
    for above in (trained.parent, trained.parents[1], trained.parents[2]):
        done = called("ns-eval", above)
        assert f"runs in {above}: {trained}" in done.stderr
        assert (trained / "eval.json").exists()
        (trained / "eval.json").unlink()


@pytest.mark.medium
def test_data_that_has_moved(tiny: Path, tmp_path: Path, refused: Refused) -> None:
    run = train(tiny, tmp_path / "out", "--max-num-iterations", 1, "--max-eval-images", 0)
    tiny.rename(tmp_path / "moved")
    words = f"the run's data {tiny} does not exist; give its new location: --data DIR"
    assert words in refused(evaluate.main, run)
    assert words in refused(render.main, "orbit", run, "--output-path", tmp_path / "o.gif")
    assert words in refused(train_command.main, "--resume", run)
    done = called("ns-eval", run, "--data", tmp_path / "moved" / "transforms_test.json", "--max-images", 1)
    assert done.returncode == 0, done.stderr


def test_a_place_that_cannot_be_written(trained: Path, tmp_path: Path, refused: Refused) -> None:
    """Told before anything is rendered."""
    (tmp_path / "file").touch()
    place = tmp_path / "file" / "o.gif"
    words = f"cannot write {place}: Not a directory; name another place"
    assert words in refused(render.main, "orbit", trained, "--output-path", place)
    assert "transforms_train.json: Not a directory" in refused(export.main, "cameras", trained, "--output-dir", place)
    if Path("/proc/self").exists():  # where not even root makes files
        assert "cannot write /proc/o.gif: " in refused(render.main, "orbit", trained, "--output-path", "/proc/o.gif")


def test_a_checkpoint_of_another_method_or_size(trained: Path, tmp_path: Path, refused: Refused) -> None:
    (checkpoint,) = (trained / "nerfstudio_models").glob("*.ckpt")
    data = ("--data", read_run(trained).config.data, "--output-dir", tmp_path, "--load-checkpoint", checkpoint)
    said = refused(train_command.main, "vanilla-nerf", *data, "--vis", "none")
    assert "of instant-ngp" in said
    assert "vanilla-nerf" in said
    said = refused(train_command.main, "instant-ngp", *data, *TINY_NGP, "--hidden-width", 32)
    assert "does not fit the model's settings: its field." in said
    assert "give the flags that it was trained with" in said


def write_capture(folder: Path) -> Path:
    """Nine photographs in the nerfstudio format."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for index in range(9):
        image, pose = ball_view(0.6 * index, 20)
        Image.fromarray(image[..., :3]).save(folder / "images" / f"{index}.jpg")
        frames.append({"file_path": f"images/{index}.jpg", "transform_matrix": pose})
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 27, "w": 20, "h": 20, "frames": frames}))
    return folder


def test_one_image_of_another_size(tiny: Path, tmp_path: Path, refused: Refused) -> None:
    Image.new("RGBA", (24, 20)).save(tiny / "train" / "r_3.png")
    said = refused(train_command.main, "instant-ngp", "--data", tiny, *TINY_NGP)
    assert "r_3.png is 24x20 pixels" in said
    capture = write_capture(tmp_path / "capture")
    Image.new("RGB", (30, 20)).save(capture / "images" / "3.jpg")
    said = refused(train_command.main, "instant-ngp", "--data", capture, *TINY_NGP)
    assert "3.jpg is 30x20 pixels" in said
    assert said.endswith("restore it, or remove it from the data")


@pytest.mark.medium
def test_damaged_photographs_in_our_words_and_thumbnails_with_a_warning(tmp_path: Path) -> None:
    capture = write_capture(tmp_path / "capture")
    first = capture / "images" / "1.jpg"
    whole = first.read_bytes()
    flags = ("--data", capture, "--output-dir", tmp_path / "out", "--max-num-iterations", 1, "--max-eval-images", 0)
    for number, (content, words) in enumerate(
        (
            (whole[: len(whole) * 2 // 3], "it is damaged or truncated; copy it again"),
            (b"", "the file is empty; copy it again"),
            (b"no image", "it is not an image, or its beginning is damaged; copy it again"),
        )
    ):
        first.write_bytes(content)
        few = ("--downscale-factor", 2) if number == 0 else ()
        done = called("ns-train", "instant-ngp", *flags, "--timestamp", number, *few, *TINY_NGP)
        assert f"{first} is not a readable image: {words}" in done.stderr
        assert ("images of 10 pixels" in done.stderr) == (number == 0)


def test_output_over_the_input(tmp_path: Path, refused: Refused) -> None:
    folder = tmp_path / "scan" / "images"
    folder.mkdir(parents=True)
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(folder / "0.jpg")
    for data, words in ((folder, "overlaps the files written"), (folder.parent, "is the same folder as --data")):
        said = refused(process_data.main, "images", "--data", data, "--output-dir", folder.parent)
        assert words in said
        assert said.endswith(f"--output-dir {tmp_path / 'scan-processed'}")
    shutil.move(folder, folder.with_name("raw"))  # beside the output: no file is in danger
    said = refused(process_data.main, "images", "--data", folder.with_name("raw"), "--output-dir", folder.parent)
    assert "has 'raw' but no transforms.json; choose a new folder or use --overwrite" in said

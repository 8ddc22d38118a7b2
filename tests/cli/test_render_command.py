"""ns-render of a scene that moves."""

from pathlib import Path

import pytest
import torch
from PIL import Image

from nerfloom.cli.render import main
from nerfloom.evaluation.paths import Walk
from nerfloom.video.views import about
from tests.conftest import EditJson, Refused
from tests.training.helpers import tiny_trainer


@pytest.fixture
def moving_run(tiny: Path, edit_json: EditJson, tmp_path: Path) -> Path:
    """The config of a K-Planes run of a few steps."""
    edit_json(lambda c: [frame.update(time=i / 9) for i, frame in enumerate(c["frames"])])
    trainer = tiny_trainer("kplanes", tiny, tmp_path / "run", max_num_iterations=20)
    assert trainer.model.scene.moving
    trainer.train()
    return trainer.folder / "config.yml"


def render(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> None:
    monkeypatch.setattr("sys.argv", ["ns-render", *map(str, arguments)])
    main()


@pytest.mark.medium
def test_one_camera_while_time_runs(moving_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flags = ["--load-config", moving_run, "--num-frames", 3, "--split", "train", "--camera-index", 2]
    render(monkeypatch, "time", *flags, "--output-path", tmp_path / "strip.png")
    render(monkeypatch, "time", *flags, "--output-path", tmp_path / "time.gif")
    with Image.open(tmp_path / "strip.png") as strip, Image.open(tmp_path / "time.gif") as animation:
        assert strip.size == (3 * 20, 20)
        assert (animation.n_frames, animation.size) == (3, (20, 20))  # type: ignore[attr-defined]


@pytest.mark.medium
def test_a_circle_at_one_time(moving_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flags = ["--load-config", moving_run, "--num-frames", 2, "--output-path", tmp_path / "orbit.gif"]
    render(monkeypatch, "orbit", *flags, "--time", 0.5)
    assert (tmp_path / "orbit.gif").is_file()


@pytest.mark.medium
def test_what_cannot_be_is_refused(moving_run: Path, shared_tiny: Path, tmp_path: Path, refused: Refused) -> None:
    still = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "still", max_num_iterations=1)
    still.train()
    standing = ("--load-config", still.folder / "config.yml")
    assert "have no times" in refused(main, "time", *standing)
    assert "have no times" in refused(main, "orbit", *standing, "--time", 0.5)
    assert "must be from 0 to 1" in refused(main, "orbit", "--load-config", moving_run, "--time", 2, status=2)
    assert "has cameras 0 to" in refused(main, "time", "--load-config", moving_run, "--camera-index", 99, status=2)


def test_what_a_walk_leaves_out_and_where_it_jumps_is_said() -> None:
    whole, first, second = torch.arange(9), torch.arange(3), torch.arange(4, 9)
    assert about(Walk((whole,), closed=True), 9) == []
    (jump,) = about(Walk((first, torch.arange(3, 9))), 9)
    assert "jumps once" in jump
    left, jump = about(Walk((first, second)), 9)
    assert "1 of 9 photographs" in left
    (jumps,) = about(Walk((first, torch.arange(3, 6), torch.arange(6, 9))), 9)
    assert "jumps 2 times" in jumps

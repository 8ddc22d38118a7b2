"""Commands that browsers start: their output, their progress and their end."""

import json
import os
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from nerfloom.base.errors import ConfigError
from nerfloom.export.kinds import KINDS, export
from nerfloom.geometry.regions import Box, Region, read_regions
from nerfloom.training.load import load
from nerfloom.viewer import commands, trained_viewer
from nerfloom.viewer.command_panel import CommandPanel
from nerfloom.viewer.commands import Commands, follow
from nerfloom.viewer.export_panel import ExportPanel, choices, folder_of, newest
from tests.cli.helpers import called
from tests.edit.clouds import ball_in_capture
from tests.patience import until

PRINTS = """
import os, sys
print("42 frames take long", file=sys.stderr)
print("Rendering: 34 %, 41 of 120, 12 s left", os.environ["NERFLOOM_PROGRESS"], file=sys.stderr)
print("error: the disk is full", file=sys.stderr)
sys.exit(int(sys.argv[1]))
"""
IS_A_TERMINAL = """
from nerfloom.base.console import console, say
say(str(console.is_terminal))
"""
WAITS = """
import os, sys, time
print("begun", file=sys.stderr, flush=True)
while not os.path.exists(sys.argv[1]):
    time.sleep(0.01)
"""


@pytest.fixture(autouse=True)
def _scripts(monkeypatch: pytest.MonkeyPatch) -> None:
    """A module is the text of a program here."""
    monkeypatch.setattr(commands, "python_command", lambda text, *words: [sys.executable, "-c", text, *map(str, words)])


@pytest.mark.parametrize("status", [0, 3])
def test_what_a_command_prints(status: int, capsys: pytest.CaptureFixture[str]) -> None:
    told: list[tuple[str, int | None]] = []
    process = Commands([]).start(PRINTS, [status])
    assert process is not None
    assert follow(process, lambda line, percent: told.append((line, percent))) == status
    assert told == [
        ("42 frames take long", None),
        ("Rendering: 34 %, 41 of 120, 12 s left often", 34),
        ("error: the disk is full", None),
    ]
    said = capsys.readouterr().err
    assert "the disk is full" in said
    assert "Rendering" not in said  # the page shows it


@pytest.mark.parametrize("variable", ["FORCE_COLOR", "TTY_COMPATIBLE"])
def test_progress_comes_as_lines_whatever_the_terminal_is_said_to_be(
    variable: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(variable, "1")
    told, process = list[str](), Commands([]).start(IS_A_TERMINAL, [])
    assert process is not None
    assert follow(process, lambda line, _: told.append(line)) == 0
    assert told == ["False"]


def test_there_is_one_at_a_time_and_it_can_be_stopped(tmp_path: Path) -> None:
    running, told, ended = Commands([]), list[str](), list[int]()

    def run(file: Path) -> threading.Thread:
        told.clear()
        process = running.start(WAITS, [file])
        assert process is not None
        thread = threading.Thread(target=lambda: ended.append(follow(process, lambda line, _: told.append(line))))
        thread.start()
        until(lambda: told)
        return thread

    first = run(tmp_path / "end")
    assert running.start(PRINTS, [0]) is None
    (tmp_path / "end").touch()
    first.join()
    assert ended == [0]
    assert told == ["begun"]
    second = run(tmp_path / "never")
    running.close()
    second.join()
    assert ended[1] != 0
    running.close()  # nothing is left to stop
    assert running.start(PRINTS, [0]) is None  # and nothing begins that would outlive the viewer


class Screen:
    """The controls of a browser, and its downloads."""

    press: Callable[[Any], None]

    def __init__(self) -> None:
        self.gui, self.sent = self, list[tuple[str, bytes]]()

    def add_progress_bar(self, value: float, visible: bool) -> SimpleNamespace:
        self.bar = SimpleNamespace(value=value, visible=visible)
        return self.bar

    def add_markdown(self, content: str) -> SimpleNamespace:
        self.note = SimpleNamespace(content=content)
        return self.note

    def add_button(self, label: str, visible: bool = True) -> SimpleNamespace:
        self.button = SimpleNamespace(visible=visible, on_click=lambda action: setattr(self, "press", action))
        return self.button

    def add_dropdown(self, label: str, options: list[str], initial_value: str) -> SimpleNamespace:
        return SimpleNamespace(value=initial_value)

    def send_file_download(self, name: str, content: bytes, save_immediately: bool) -> None:
        self.sent.append((name, content))


def test_a_second_press_leaves_the_progress_of_the_first(tmp_path: Path) -> None:
    running, screen, file = Commands([]), Screen(), tmp_path / "splat.ply"
    file.write_bytes(b"ply")
    panel = CommandPanel(cast(Any, screen), running)
    first = threading.Thread(target=lambda: panel.run(WAITS, [tmp_path / "end"], lambda: file))
    first.start()
    until(lambda: screen.note.content == "begun")
    panel.run(PRINTS, [0], lambda: file)
    assert screen.note.content.startswith("Another command is running")
    assert screen.bar.visible
    (tmp_path / "end").touch()
    first.join()
    assert "Wrote splat.ply" in screen.note.content
    assert (screen.bar.visible, screen.button.visible) == (False, True)


def test_a_file_is_sent_once(tmp_path: Path) -> None:
    """Each download holds the file in memory until the browser has read it."""
    screen, file = Screen(), tmp_path / "splat.ply"
    file.write_bytes(b"ply")
    panel = CommandPanel(cast(Any, screen), Commands([]))
    screen.press(None)  # before there is any
    panel.run(PRINTS, [0], lambda: file)
    for _ in range(3):
        screen.press(None)
    assert screen.sent == [("splat.ply", b"ply")]
    assert not screen.button.visible


def test_an_export_has_a_crop_file_of_its_own(tmp_path: Path) -> None:
    """The files saved in the run's folder stay as they are."""
    boxes, screen = [Box((-1.0, -1.0, 0.0), (1.0, 1.0, 2.0)), Box((0.0, 0.0, 0.0), (3.0, 3.0, 3.0))], Screen()
    read, files = list[Region](), list[Path]()

    def start(module: str, words: list[Any]) -> None:
        assert words[-2:] == opens
        flags = dict(zip(words[1:-2:2], words[2:-2:2], strict=True))
        files.append(flags["--region"])
        read.extend(read_regions(files[-1]))

    opens = ["--load-config=run", "--data=elsewhere"]
    loaded = SimpleNamespace(model=SimpleNamespace(), folder=tmp_path, is_run=True, source=object())
    left = boxes.copy()
    given: list[Any] = [
        screen,
        lambda: loaded,
        lambda: None,
        SimpleNamespace(regions=lambda: [left.pop(0)]),
        SimpleNamespace(start=start, opens=opens),
    ]
    panel = ExportPanel(*given)
    panel._export()
    panel._export()
    assert read == boxes
    assert not any(file.exists() for file in files)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """Gaussians in the frame of a capture beside them."""
    ball_in_capture(tmp_path)
    return tmp_path / "ball.ply"


@pytest.mark.parametrize("words", [(), ("--data", "capture", "nerfstudio", "--eval-interval", 3)])
def test_what_a_file_can_be_exported_as_is_offered(scene: Path, words: tuple[object, ...], tmp_path: Path) -> None:
    """Each export that is not offered would be refused for what the file lacks."""
    loaded = load(scene, data=tmp_path / "capture" if words else None)
    found = {name for name, _ in choices(loaded).values()}
    known = {"pointcloud", "tsdf", "cameras"} if words else set()
    assert found == {"gaussian-splat", "levels", "web"} | known
    assert {end for name, end in choices(loaded).values() if name == "gaussian-splat"} == {
        ".ply",
        ".spz",
        ".sog",
        ".glb",
    }
    for name in set(KINDS) - found:
        kind = KINDS[name]
        with pytest.raises(ConfigError, match=r"--data|has no"):
            export(loaded, name, tmp_path / f"a{kind.suffixes[0]}", kind.settings())
    assert folder_of(loaded) == tmp_path / "exports" / "ball"


def test_commands_open_what_the_viewer_shows(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands take the flags that opened a file, and those of its data format, after flags of their own."""
    given: list[Any] = []
    monkeypatch.setattr(trained_viewer, "view_loaded", lambda *words: given.append(words))
    words = ("ball.ply", "--data", "capture", "--websocket-port", 17999, "nerfstudio", "--eval-interval", 3)
    shown = called("ns-viewer", *words, "--device-type", "cpu", folder=tmp_path)
    assert shown.returncode == 0, shown.stderr
    loaded, commands = given[0][0], given[0][3]
    assert commands.opens == [
        *("--load-config=ball.ply", "--data=capture", "--device-type=cpu"),
        *("nerfstudio", "--eval-interval=3"),
    ]
    done = called("ns-export", "cameras", "--output-dir", "exports", *commands.opens, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "exports" / "transforms_train.json").read_text())
    monkeypatch.chdir(tmp_path)
    assert len(content) == len(loaded.parsed("train").image_paths) == 6  # all but every third of nine
    path = ("--camera-path-filename", "no.json", "--output-path", "a.gif")
    assert "no.json" in called("ns-render", "camera-path", *path, *commands.opens, folder=tmp_path).stderr
    assert called("ns-viewer", "ball.ply", "--up=-y", folder=tmp_path).returncode == 0
    assert given[1][3].opens == ["--load-config=ball.ply", "--up=-y"]


def test_the_newest_file_is_offered(tmp_path: Path) -> None:
    for age, name in enumerate(("b.ply", "a.ply", "c.ply", "d.spz")):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (1000 - age, 1000 - age))
    assert newest(tmp_path, ".ply").name == "b.ply"

"""Errors in the flags of any command: one line with the fault and a reference, and exit status 2."""

import sys
from importlib.metadata import entry_points
from pathlib import Path

import pytest
import tyro

from nerfloom.cli.flags import in_one_line, read_flags
from nerfloom.cli.viewer import ViewerFlags
from tests.cli.helpers import called

COMMANDS = {
    "ns-bake": [],
    "ns-bench": ["kernels"],
    "ns-blocks": [],
    "ns-compare": [],
    "ns-download-data": ["blender"],
    "ns-edit": [],
    "ns-eval": [],
    "ns-export": ["pointcloud"],
    "ns-measure": [],
    "ns-new-method": ["my-method"],
    "ns-process-data": ["images"],
    "ns-render": ["orbit"],
    "ns-stress": ["instant-ngp"],
    "ns-train": ["instant-ngp"],
    "ns-viewer": [],
}
"""Each command, and the arguments before its flags."""


def said(name: str, *words: object) -> str:
    """The one line that answers."""
    done = called(name, *words)
    lines = done.stderr.splitlines()
    assert (done.returncode, len(lines), done.stdout) == (2, 1, ""), done.stderr
    return lines[0]


def test_all_commands_are_tried() -> None:
    points = entry_points(group="console_scripts")
    assert sorted(COMMANDS) == sorted(point.name for point in points if point.value.startswith("nerfloom.cli."))


@pytest.mark.parametrize("name", COMMANDS)
def test_an_unknown_flag(name: str) -> None:
    line = said(name, *COMMANDS[name], "--no-such-flag", 3)
    assert line.startswith("error: ")
    assert "unknown flag --no-such-flag" in line
    assert line.endswith(" --help shows the flags")


@pytest.mark.parametrize(
    ("name", "words", "line"),
    [
        ("ns-eval", [], "--load-config is missing; ns-eval --help shows the flags"),
        (
            "ns-eval",
            ["--load-config", "x", "--max-images", "many"],
            "--max-images is 'many'; it must be a whole number; ns-eval --help shows the flags",
        ),
        (
            "ns-eval",
            ["--load-config", "x", "--split", "tset"],
            "--split is 'tset'; it must be one of 'test', 'val', 'train'; ns-eval --help shows the flags",
        ),
        (
            "ns-eval",
            ["--load-config", "x", "blender", "--downscale-factor", "two"],
            "--downscale-factor is 'two'; it must be a whole number; ns-eval blender --help shows the flags",
        ),
        (
            "ns-render",
            ["orbit", "x", "--output-pth", "y"],
            "unknown flag --output-pth. Did you mean '--output-path'? ns-render orbit --help shows the flags",
        ),
        (
            "ns-export",
            ["pointcloud", "x", "--output-dir", "y", "--reach", "far"],
            "--reach is 'far'; it must be a number; ns-export pointcloud --help shows the flags",
        ),
        ("ns-bench", ["kernels", "avx2"], "unexpected argument 'avx2'; ns-bench kernels --help shows the flags"),
        ("ns-train", ["--resume"], "--resume needs a value"),
        (
            "ns-train",
            ["instant-ngp", "--max-seconds"],
            "--max-seconds needs a value; ns-train instant-ngp --help shows the flags",
        ),
    ],
)
def test_what_is_said(name: str, words: list[str], line: str) -> None:
    assert said(name, *words) == f"error: {line}"


@pytest.mark.parametrize(
    ("name", "words", "line"),
    [
        ("ns-eval", ["x", "--max-images", 0], "--max-images is 0; it must be at least 1"),
        (
            "ns-render",
            ["orbit", "x", "--output-path", "y.gif", "--num-frames", 0],
            "--num-frames is 0; it must be at least 1",
        ),
        (
            "ns-render",
            ["orbit", "x", "--output-path", "y.gif", "--num-frames", 100_001],
            "--num-frames makes 100,001 frames; the limit is 100,000",
        ),
        (
            "ns-process-data",
            ["video", "--data", "x", "--output-dir", "y", "--num-frames-target", 1],
            "--num-frames-target is 1; it must be at least 3",
        ),
        (
            "ns-compare",
            ["--methods", "instant-ngp", "--max-seconds", 1, "--repeats", 0],
            "--repeats is 0; it must be at least 1",
        ),
        (
            "ns-stress",
            ["instant-ngp", "--max-num-iterations", 0],
            "--max-num-iterations must be at least 1, and --max-seconds more than 0",
        ),
    ],
)
def test_a_value_out_of_range(name: str, words: list[object], line: str) -> None:
    """Other commands agree with ns-train, which test_commands.py covers."""
    assert said(name, *words) == f"error: {line}"


def test_terminals_without_frames() -> None:
    """Terminals that show ASCII alone."""
    box = (
        " Required options\n"
        " ---------------- \n"
        "  Missing from ns-eval:\n"
        "      --load-config PATH\n"
        "          Folder of the run. (required)\n"
        "  ---------------------\n"
        "  Unrecognized options:\n"
        "      --fast\n"
        "      3\n"
        "  ---------------------\n"
        "  For full helptext, run ns-eval --help\n"
    )
    words = "--load-config is missing, and there is an unknown flag --fast; ns-eval --help shows the flags"
    assert in_one_line(box, "ns-eval") == words


def test_what_is_not_known_is_said_as_it_is() -> None:
    rows = ("╭─ News ────╮", "│ A new kind │", "│ of it.     │", "│ ────────── │", "│ See --help │", "╰───────────╯")
    box = "".join(f"\033[31m{row}\033[0m\n" for row in rows)
    assert in_one_line(box, "ns-eval") == "A new kind of it; ns-eval --help shows the flags"
    assert in_one_line("mistake", "ns-eval") == "mistake; ns-eval --help shows the flags"


@pytest.mark.parametrize("flag", ["'--max-images'", "'('--max-images',)'"], ids=["tyro 1.0.17", "tyro 1.0.0"])
def test_a_flag_without_its_value_as_each_tyro_names_it(flag: str) -> None:
    box = f"╭ Parsing error ─────╮\n│ Missing value for argument {flag}. Expected 1 values. │\n╰────────────────────╯\n"
    assert in_one_line(box, "ns-eval") == "--max-images needs a value; ns-eval --help shows the flags"


def test_help_is_no_error() -> None:
    done = called("ns-eval", "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert "--load-config" in done.stdout


def test_warnings_are_passed_on(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def cli(kind: type, **_: object) -> object:
        print("careful", file=sys.stderr)
        return kind(load_config=Path("x"))

    monkeypatch.setattr(tyro, "cli", cli)
    assert read_flags(ViewerFlags, "ns-viewer", []).load_config == Path("x")
    assert capsys.readouterr().err == "careful\n"

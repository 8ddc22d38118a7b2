"""Whether a command of the documents is one: its flags are parsed by the command itself, up to where work begins."""

import re
import shutil
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

import nerfloom.training.load  # modules that name find_data or config_file must have the true ones, if a check is first
import nerfloom.training.teacher  # noqa: F401
from nerfloom.registry import load_dataparser, registered
from nerfloom.training.run import Run
from tests.site.pages import ROOT

EXAMPLES = ("my-method", "plain-grid")
"""Methods that the documents let their readers write."""
UNCHECKED = ("nerfbaselines", "export", ".", "source", "pytest")
"""Commands of others, and commands without a parser here."""
TAKE_RUNS = ("run_flags",)
"""Functions that check for a trained run."""
SURFACES = "scan.ply", "scan_points.ply", "made_elsewhere.glb", "solids/reference.ply"
"""Files of surfaces that commands of the documents name."""
FORMATS = {"lego": "blender", "balls": "dnerf", "ring": "blender"}
"""Name of a folder in the documents -> its format; of any other, nerfstudio."""


class Begun(Exception):
    """The command has understood its flags and begins to work."""


def begin(*_: Any, **__: Any) -> None:
    raise Begun


def found(path: Path | None, named: str | None = None) -> tuple[Path | None, str]:
    """Stands for find_data, since the folders of the documents are not there."""
    return path, named or ("procedural" if path is None else FORMATS.get(path.name, "nerfstudio"))


class Checker:
    """Runs commands until they would begin to work, in an empty folder.

    Args:
        monkeypatch: exchanges functions for the checks, and puts them back after them.
        folder: working folder.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
        monkeypatch.chdir(folder)
        shutil.copytree(ROOT / "configs", folder / "configs")
        (folder / "path" / "to" / "masks").mkdir(parents=True)
        (folder / "solids").mkdir()
        for name in SURFACES:
            (folder / name).touch()
        exchanged: dict[str, Callable[..., Any]] = {
            "nerfloom.training.data_folder.find_data": found,
            "nerfloom.cli.train_paths.check_paths": lambda *_: None,
            "nerfloom.training.run_path.config_file": lambda path: path if path.suffix else path / "config.yml",
            "benchmarks.__main__.trained_run": lambda path, *_: path,
            **{f"nerfloom.cli.{name}.trained_run": lambda path, *_: path for name in TAKE_RUNS},
            **{
                f"nerfloom.cli.{name}.check_data": lambda path: None
                for name in ("bench_results", "blocks", "compare", "stress")
            },
            "nerfloom.cli.session.start": begin,
            "nerfloom.cli.session.resume": begin,
            "nerfloom.training.load.load": begin,
            "nerfloom.export.run_levels.export_file_levels": begin,
            "nerfloom.cli.evaluate_geometry.read_reference": lambda flags: None,
            "nerfloom.processing.kinds._check_input": begin,
            "nerfloom.cli.compare.compare": begin,
            "nerfloom.cli.blocks.build": begin,
            "nerfloom.cli.stress.stress": stress,
            "nerfloom.downloads.install.announce": begin,
        }
        for name, replacement in exchanged.items():
            module, _, attribute = name.rpartition(".")
            if find_spec(module.rpartition(".")[0]) is None:
                continue
            monkeypatch.setattr(import_module(module), attribute, replacement)
        train = import_module("nerfloom.cli.train")
        read = train._read_run
        monkeypatch.setattr(train, "_read_run", lambda path: read(path) if path.is_file() else run_at(path))
        for bench in map(import_module, ("nerfloom.cli.bench", "benchmarks.__main__")):
            for name, (flags, _) in bench.KINDS.items():
                monkeypatch.setitem(bench.KINDS, name, (flags, begin))

    def check(self, words: list[str]) -> None:
        """Raise an error if a command does not exist, or does not understand its flags."""
        name, *rest = words
        if name == "torchrun":
            if "ns-train" in words:
                self.check(words[words.index("ns-train") :])
        elif name.startswith("ns-"):
            self._ours(name, ["tensorf" if word in EXAMPLES and name != "ns-new-method" else word for word in rest])
        elif name == "make":
            targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
            assert rest[0] in targets, f"make has no target {rest[0]}"
        elif name == "pip":
            check_extras(rest)
        elif words[1:3] == ["-m", "benchmarks"]:
            assert status_of(import_module("benchmarks.__main__").main.__wrapped__, words[3:]) in (0, None)
        elif name in ("python", "python3"):
            check_python(rest)
        else:
            assert name in UNCHECKED, f"{name} is not a command that is known here"

    def _ours(self, name: str, rest: list[str]) -> None:
        scripts = dict(re.findall(r'^(ns-[\w-]+) = "(.+):main"$', (ROOT / "pyproject.toml").read_text(), re.MULTILINE))
        assert name in scripts, f"pyproject.toml has no command {name}"
        if rest[:1] == ["--version"]:
            return
        status = status_of(import_module(scripts[name]).main.__wrapped__, rest)
        assert status in (0, None), "it does not understand its flags"
        begun_without_working = (
            status is None or rest[-1] in ("--help", "--help-all") or name in ("ns-new-method", "ns-stress")
        )
        assert begun_without_working, "it ended without beginning"


def status_of(command: Callable[[list[str]], None], words: list[str]) -> Any:
    """The exit status of a command; None if it has begun to work."""
    try:
        command(words)
    except Begun:
        return None
    except SystemExit as end:
        return end.code or 0
    return 0


def run_at(path: Path) -> Run:
    """The run that a path of the documents stands for: its method with its defaults."""
    (method,) = [part for part in path.parts if part in registered("methods")]
    return import_module("nerfloom.cli.train")._default_run(method)


def stress(methods: list[str], flags: Any) -> list[Any]:
    module = import_module("nerfloom.cli.stress")
    for method in methods:
        module._run(method, flags)
    module._conditions(flags)
    return []


def check_extras(words: list[str]) -> None:
    assert words[0] == "install"
    text = (ROOT / "pyproject.toml").read_text()
    for extra in re.findall(r"\.\[([\w,]+)\]", " ".join(words)):
        for name in extra.split(","):
            assert re.search(rf"^{name} = \[", text, re.MULTILINE), f"there is no extra {name}"


def check_python(words: list[str]) -> None:
    if words[0] == "-m":
        assert find_spec(words[1]) is not None, f"there is no module {words[1]}"
    elif words[0] != "-c":
        assert (ROOT / words[0]).is_file(), f"there is no file {words[0]}"


def formats() -> list[str]:
    """The data formats that the documents name; each can be loaded."""
    return [load_dataparser(name).__name__ for name in {*FORMATS.values(), "nerfstudio"}]

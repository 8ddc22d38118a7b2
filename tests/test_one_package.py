"""Everything is imported as nerfloom, with any files in the working folder."""

import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from nerfloom.base.child import SAFE, python_command
from tests.forked import Forks

SHADOW = 'raise SystemExit("a file of the working folder was imported")\n'
COMMANDS = sorted(
    point.value.split(":")[0]
    for point in entry_points(group="console_scripts")
    if point.value.startswith("nerfloom.cli.")
)


@pytest.fixture
def shadowed(tmp_path: Path) -> Path:
    """A folder with the names of this repository's folders, one that looks like a checkout of it."""
    for name in ("framework", "dataparsers"):
        (tmp_path / f"{name}.py").write_text(SHADOW)
    (tmp_path / "methods").mkdir()
    (tmp_path / "methods" / "__init__.py").write_text(SHADOW)
    return tmp_path


def output_of(words: list[str], folder: Path) -> str:
    """Output of a program that is started in a folder and must succeed."""
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.medium
def test_a_notebook_imports_nothing_of_the_working_folder(shadowed: Path, forks: Forks) -> None:
    """Python has the working folder first on its path there."""
    code = (
        "import os, sys; os.chdir(sys.argv[1]); sys.path[0] = ''\n"
        "import nerfloom as n; print(*n.list_methods()); n.Method; n.runs.load_dataparser('blender')"
    )
    done = forks.run(code, shadowed)
    assert done.returncode == 0, done.stderr
    assert "instant-ngp" in done.stdout.split()


HELP = """
import runpy, sys
for module in sys.argv[1:]:
    sys.argv = [module, "--help"]
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as end:
        if end.code:
            raise
    print("end of", module)
"""
"""A program that shows the help of commands, one after the other; a command in a process of its own takes longer."""


@pytest.mark.medium
def test_no_command_imports_anything_of_the_working_folder(shadowed: Path) -> None:
    """Python has the working folder first on its path here, too."""
    said = output_of([sys.executable, "-c", HELP, *COMMANDS], shadowed)
    assert said.count("ns-") > len(COMMANDS)
    assert [line.split()[-1] for line in said.splitlines() if line.startswith("end of ")] == COMMANDS


@pytest.mark.medium
def test_a_child_imports_no_name_of_the_working_folder(shadowed: Path) -> None:
    """It does not import names of other packages either, from Python 3.11 on."""
    if SAFE:
        for name in ("tyro", "runpy", "nerfloom"):
            (shadowed / f"{name}.py").write_text(SHADOW)
    assert "--max-seconds" in output_of(python_command("nerfloom.cli.train", "instant-ngp", "--help"), shadowed)

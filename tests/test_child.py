"""Children run the package of their parent, whatever lies in the folder that they are started in."""

import subprocess
import sys
from pathlib import Path

import pytest

from framework.base.child import PACKAGE, python_command

SHADOW = 'raise SystemExit("a file of the working folder was imported")\n'


@pytest.fixture
def shadowed(tmp_path: Path) -> Path:
    """A folder with files called like our packages, and one that looks like a checkout of ours."""
    for name in ("methods", "dataparsers", "tyro", "runpy"):
        (tmp_path / f"{name}.py").write_text(SHADOW)
    (tmp_path / "framework").mkdir()
    (tmp_path / "framework" / "__init__.py").write_text(SHADOW)
    return tmp_path


@pytest.mark.medium
def test_a_child_imports_nothing_of_the_working_folder(shadowed: Path) -> None:
    command = python_command("framework.cli.train", "instant-ngp", "--version")
    done = subprocess.run(command, cwd=shadowed, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert f"from {PACKAGE} " in done.stdout
    command = python_command("framework.cli.train", "instant-ngp", "--help")
    done = subprocess.run(command, cwd=shadowed, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "--max-seconds" in done.stdout


@pytest.mark.skipif(sys.version_info < (3, 11), reason="-P came with Python 3.11")
def test_where_python_puts_no_folder_first(shadowed: Path) -> None:
    """PYTHONSAFEPATH, or -P: there is nothing to take away then, and nothing else is."""
    code = "import sys; sys.argv = {words}; import runpy; runpy.run_path(sys.argv[0], run_name='__main__')"
    words = python_command("framework.cli.train", "--version")[1:]
    command = [sys.executable, "-P", "-c", code.format(words=words)]
    done = subprocess.run(command, cwd=shadowed, capture_output=True, text=True)
    assert f"from {PACKAGE} " in done.stdout, done.stderr


def test_a_parent_that_is_not_installed_hands_its_place_on(shadowed: Path) -> None:
    """A copy of the package that no path leads to runs itself, and not the installed one."""
    copy = shadowed / "elsewhere" / "framework"
    copy.mkdir(parents=True)
    (copy / "base").mkdir()
    (copy / "base" / "child.py").write_text((PACKAGE / "base" / "child.py").read_text())
    (copy / "__init__.py").write_text("")
    (copy / "program.py").write_text("import framework, sys; print(framework.__file__, sys.argv[1:])")
    command = [sys.executable, str(copy / "base" / "child.py"), "framework.program", "a b"]
    done = subprocess.run(command, cwd=shadowed, capture_output=True, text=True)
    assert done.stdout.split() == [str(copy / "__init__.py"), "['a", "b']"], done.stderr


def test_no_file_beside_it_is_called_like_a_module_of_python() -> None:
    """Its folder is first on the path for the moment that it takes to remove it."""
    assert not {path.stem for path in (PACKAGE / "base").iterdir()} & set(sys.stdlib_module_names)

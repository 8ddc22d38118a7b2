"""ns-new-method: its file is a method, and its errors."""

import ast
import dataclasses
import importlib
from pathlib import Path

import pytest

from nerfloom.base.errors import ConfigError
from nerfloom.cli.new_method import TEMPLATES, check_name, main, package_of
from nerfloom.testing import assert_method
from tests.conftest import Refused

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "plugin-method"
IGNORED = {"__pycache__", ".pytest_cache", "build"}


def files(folder: Path) -> dict[str, str]:
    """The files of a folder, without Python's caches."""
    found = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    kept = (path for path in found if not any(p in IGNORED or p.endswith(".egg-info") for p in path.parts))
    return {path.as_posix(): (folder / path).read_text(encoding="utf-8") for path in kept}


def test_the_example_is_what_the_command_writes() -> None:
    """Commands to renew it: rm -r examples/plugin-method; ns-new-method dense-grid --dir examples/plugin-method"""
    assert files(EXAMPLE) == package_of("dense-grid")


def test_the_documentation_says_how_long_the_example_is() -> None:
    (source,) = (EXAMPLE / "src").glob("*.py")
    length = len(source.read_text(encoding="utf-8").splitlines())
    assert f"one file of {length} lines" in (ROOT / "docs" / "plugins.md").read_text(encoding="utf-8")


def test_it_writes_a_package_and_says_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["ns-new-method", "my-3d-grid"])
    main()
    said = capsys.readouterr().out
    for command in ("pip install -e 'my-3d-grid[test]'", "ns-train my-3d-grid ", "python -m pytest my-3d-grid"):
        assert command in said
    written = files(tmp_path / "my-3d-grid")
    assert set(written) == {"README.md", "pyproject.toml", "src/my_3d_grid.py", "tests/test_method.py"}
    assert not any("$" in content for content in written.values())
    project = written["pyproject.toml"]
    assert 'name = "nerfloom-my-3d-grid"' in project
    assert '[project.entry-points."nerfloom.methods"]\nmy-3d-grid = "my_3d_grid:METHOD"' in project
    source = written["src/my_3d_grid.py"]
    assert len(source.splitlines()) <= 150
    assert {"My3dGridConfig", "My3dGridField"} == {
        node.name for node in ast.parse(source).body if isinstance(node, ast.ClassDef)
    }


def test_no_class_hides_what_it_imports() -> None:
    """No name defined in the file ends like an imported one, for every name of a method."""
    (template,) = (TEMPLATES / "src").iterdir()
    tree = ast.parse(template.read_text(encoding="utf-8").replace("${Class}", "Any").replace("$", ""))
    imported = {alias.name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names}
    defined = [node.name for node in tree.body if isinstance(node, ast.ClassDef)]
    assert len(defined) == 2
    for name in defined:
        ending = name.removeprefix("Any")
        assert not [other for other in imported if other.endswith(ending) and other != ending]


@pytest.mark.medium
def test_what_it_writes_keeps_what_every_method_must(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLE / "src"))
    method = importlib.import_module("dense_grid").METHOD
    small = dataclasses.replace(method.config, max_resolution=32, grid_resolution=32, num_steps=64)
    assert_method(method, "dense-grid", small)


@pytest.mark.parametrize("name", ["My-Method", "my_method", "3d", "-x", "x-", "x--y", "", "grid.py", "../x", "ünder"])
def test_names_that_are_none(name: str) -> None:
    with pytest.raises(ConfigError, match="is invalid"):
        check_name(name)


def test_names_that_are_taken() -> None:
    with pytest.raises(ConfigError, match="the method 'instant-ngp' already exists"):
        check_name("instant-ngp")
    for name in ("lambda", "torch", "nerfloom", "json"):
        with pytest.raises(ConfigError, match=f"the method's module would be '{name}'"):
            check_name(name)
    check_name("my-method-2")


def test_nothing_is_overwritten(tmp_path: Path, refused: Refused) -> None:
    (tmp_path / "file").write_text("mine")
    for folder in (tmp_path, tmp_path / "file"):
        assert "already exists and is not overwritten" in refused(main, "my-method", "--dir", folder)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").read_text() == "mine"
    below = tmp_path / "file" / "deeper"
    assert "; choose another --dir" in refused(main, "my-method", "--dir", below)
    assert "the method's name comes first" in refused(main, "--dir", tmp_path / "new")


@pytest.mark.parametrize("arguments", [[], ["-h"], ["my-method", "--help"]])
def test_help_writes_nothing(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["ns-new-method", *arguments])
    main()
    assert "usage: ns-new-method NAME [--dir DIR]" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []

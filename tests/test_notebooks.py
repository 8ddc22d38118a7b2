"""The notebooks run from their first cell to their last, with the described results."""

import ast
import json
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

import nerfloom
from nerfloom import registry
from tests.training.helpers import TINY

DOCS = Path(__file__).parents[1] / "docs"
FOLDER = DOCS / "notebooks"
SIZE = 24
"""Width and height of the embedded scene's images here, which take most of a minute to render as they are."""


def shown(source: str, names: dict[str, Any]) -> Any:
    """Run a cell; return the value of its last line, where that is an expression, as a notebook shows it."""
    *body, last = ast.parse(source).body
    exec(compile(ast.Module(body, []), "cell", "exec"), names)
    if isinstance(last, ast.Expr):
        return eval(compile(ast.Expression(last.value), "cell", "eval"), names)
    exec(compile(ast.Module([last], []), "cell", "exec"), names)
    return None


def code_of(name: str) -> list[str]:
    """The code of a notebook's cells."""
    cells = json.loads((FOLDER / f"{name}.ipynb").read_text())["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


@pytest.fixture
def names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, Any]]:
    """The names of a notebook, which are `__main__`'s. Scenes and methods are small, and trainings short."""
    train = nerfloom.train
    scene = partial(registry.load_dataparser("procedural"), size=SIZE, num_train=12)
    small = {"max_num_iterations": 60, "vis": "none"}

    def shortly(method: str, **settings: Any) -> nerfloom.Loaded:
        del settings["max_seconds"]
        return train(method, **{**settings, **TINY.get(method, TINY["instant-ngp"]), **small})

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("nerfloom.runs.load_dataparser", lambda name: scene)
    monkeypatch.setattr(nerfloom, "train", shortly)
    monkeypatch.setenv("NERFLOOM_METHODS", "")
    main = ModuleType("__main__")
    monkeypatch.setitem(sys.modules, "__main__", main)
    registry.registered.cache_clear()
    yield main.__dict__
    registry.registered.cache_clear()


def test_every_notebook_is_run_here_and_keeps_no_outputs() -> None:
    assert {file.stem for file in FOLDER.glob("*.ipynb")} == {
        "first-steps", "render-from-a-pose", "compare", "a-method"
    }  # fmt: skip
    for file in FOLDER.glob("*.ipynb"):
        cells = json.loads(file.read_text())["cells"]
        assert all(cell["outputs"] == [] for cell in cells if cell["cell_type"] == "code"), file


@pytest.mark.medium
def test_first_steps(names: dict[str, Any]) -> None:
    methods, run, rgb, depth, psnr = (shown(source, names) for source in code_of("first-steps"))
    assert "instant-ngp" in methods
    assert run.run.method == "instant-ngp"
    assert rgb.size == depth.size == (SIZE, SIZE)
    assert np.asarray(rgb).std() > 5  # something is to be seen
    assert len(np.unique(np.asarray(depth).reshape(-1, 3), axis=0)) > 10
    assert 8 < psnr < 60


def test_loading_and_looking_takes_six_lines_at_most() -> None:
    lines = [line for source in code_of("first-steps")[2:4] for line in source.splitlines() if line.strip()]
    assert any("load(" in line for line in lines)
    assert any('"depth"' in line for line in lines)
    assert len(lines) <= 6


@pytest.mark.medium
def test_a_pose_is_rendered_from_where_it_is(names: dict[str, Any]) -> None:
    """The point is where the pixel's ray ends; and a view's own camera gives the view."""
    folder, box, view, point, turn = (shown(source, names) for source in code_of("render-from-a-pose"))
    assert (folder / "config.yml").is_file()
    assert box.shape == (2, 3)
    assert view.size == (160, 120)
    columns, rows, ahead = names["camera"].project(point[None], 0)
    assert (round(columns.item()), round(rows.item()), ahead.item()) == (80, 60, True)
    position = names["camera"].camera_to_worlds[0, :, 3]
    depth = names["picture"].median_depth[60, 80]
    assert (point - position).norm().item() == pytest.approx(depth.item(), rel=1e-5)
    frames = np.asarray(turn).reshape(120, 4, 160, 3).swapaxes(0, 1).astype(float)
    assert all(np.abs(frames[0] - frame).mean() > 1 for frame in frames[1:])
    run = names["run"]
    of_camera, of_view = run.render(run.dataset("test").cameras[0:1]), run.render(run.views("test")[0])
    assert torch.equal(of_camera.rgb, of_view.rgb)


@pytest.mark.medium
def test_methods_are_compared_by_the_same_images(names: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    *_, strip, (mean, worst) = (shown(source, names) for source in code_of("compare"))
    said = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert [words[0] for words in said] == list(names["METHODS"])
    for method, psnr, *_ in said:
        assert 8 < float(psnr) < 60
        assert float(psnr) == pytest.approx(names["runs"][method].evaluate(max_images=4)["psnr"], abs=0.006)
    assert strip.size == (4 * SIZE, SIZE)
    parts = np.asarray(strip).reshape(SIZE, 4, SIZE, 3).swapaxes(0, 1).astype(float)
    for part, method in zip(parts[1:], names["METHODS"], strict=True):  # each is nearer than white
        found = np.square(part - parts[0]).mean()
        assert found < np.square(255 - parts[0]).mean(), method
    assert 0 < mean < worst <= 1


@pytest.mark.medium
def test_a_method_of_a_notebook_is_a_method(names: dict[str, Any]) -> None:
    *_, picture, psnr = (shown(source, names) for source in code_of("a-method"))
    assert [finding.line() for finding in names["findings"] if not finding.ok] == []
    assert len(names["findings"]) > 15
    assert names["run"].run.method == "waves"
    assert type(names["run"].model.field) is names["Waves"]
    assert picture.size == (SIZE, SIZE)
    assert 8 < psnr < 60


def test_the_site_has_a_page_of_each_with_all_of_its_code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(DOCS / "building"))
    import notebook_pages

    found = notebook_pages.notebooks(FOLDER)
    assert next(iter(found)) == "First steps"
    assert set(found.values()) == set(FOLDER.glob("*.ipynb"))
    for title, file in found.items():
        page = notebook_pages.page(file)
        assert page.startswith(f"# {title}\n\n")
        assert f"({file.name})" in page
        assert page.count("```python\n") == len(code_of(file.stem))
        assert all(f"```python\n{source}\n```" in page for source in code_of(file.stem))

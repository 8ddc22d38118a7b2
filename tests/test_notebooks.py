"""The notebooks run from their first cell to their last, and show what they say."""

import ast
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

FOLDER = Path(__file__).parents[1] / "docs" / "notebooks"
SMALL = {
    "max_seconds=10": "max_num_iterations=30, num_steps=64, grid_resolution=16, samples_per_batch=4096, vis='none'"
}
"""What a notebook's settings are exchanged for, so that it takes seconds."""


def shown(source: str, names: dict[str, Any]) -> Any:
    """Run a cell; return the value of its last line, where that is an expression, as a notebook shows it."""
    *body, last = ast.parse(source).body
    exec(compile(ast.Module(body, []), "cell", "exec"), names)
    if isinstance(last, ast.Expr):
        return eval(compile(ast.Expression(last.value), "cell", "eval"), names)
    exec(compile(ast.Module([last], []), "cell", "exec"), names)
    return None


@pytest.mark.parametrize("file", sorted(FOLDER.glob("*.ipynb")), ids=lambda file: file.stem)
def test_every_cell_runs(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NERFLOOM_CACHE", str(tmp_path / "cache"))
    cells = [cell for cell in json.loads(file.read_text())["cells"] if cell["cell_type"] == "code"]
    names: dict[str, Any] = {}
    values = []
    for cell in cells:
        assert cell["outputs"] == [], "outputs are kept out of the repository"
        source = "".join(cell["source"])
        for before, after in SMALL.items():
            source = source.replace(before, after)
        values.append(shown(source, names))
    methods, run, rgb, depth, psnr = values
    assert "instant-ngp" in methods
    assert run.run.method == "instant-ngp"
    assert rgb.size == depth.size == (200, 200)
    assert np.asarray(rgb).std() > 5  # something is to be seen
    assert len(np.unique(np.asarray(depth).reshape(-1, 3), axis=0)) > 10
    assert 8 < psnr < 60


def test_loading_and_looking_takes_six_lines_at_most() -> None:
    cells = json.loads((FOLDER / "first-steps.ipynb").read_text())["cells"]
    sources = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    lines = [line for source in sources[2:4] for line in source.splitlines() if line.strip()]
    assert any("load(" in line for line in lines)
    assert any('"depth"' in line for line in lines)
    assert len(lines) <= 6

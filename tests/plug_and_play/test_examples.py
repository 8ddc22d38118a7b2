"""The two loops of `examples/`: both learn, the second from fewer samples, and some ten lines lie between them."""

import difflib
import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

from tests.conftest import write_tiny
from tests.forked import Forks

ROOT = Path(__file__).parents[2]
PLAIN = ROOT / "examples" / "plain_nerf_loop.py"
SKIPPING = ROOT / "examples" / "plain_nerf_loop_with_skipping.py"


def loaded(file: Path) -> ModuleType:
    """A loop as a module, with fewer rays and longer steps."""
    spec = importlib.util.spec_from_file_location(file.stem, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.STEP *= module.STEPS / 64  # type: ignore[attr-defined]
    module.STEPS, module.BATCH = 64, 128  # type: ignore[attr-defined]
    return module


def differences() -> list[str]:
    """The removed lines, with "-", and the added ones, with "+"; the docstrings of the two modules are left out."""
    lines = [file.read_text().split('"""', 2)[2].splitlines() for file in (PLAIN, SKIPPING)]
    return [line for line in difflib.ndiff(*lines) if line[0] in "+-"]


def test_some_ten_lines_lie_between_them() -> None:
    """The added lines are the work of a user; the removed lines are compositing that is not needed."""
    come = [line for line in differences() if line[0] == "+"]
    go = [line for line in differences() if line[0] == "-"]
    print(f"{len(come)} lines come, {len(go)} go")
    assert 5 <= len(come) <= 14
    assert len(go) <= 14
    assert len(PLAIN.read_text().splitlines()) <= 120


def test_the_plain_loop_is_plain() -> None:
    assert "nerfloom" not in PLAIN.read_text()


@pytest.mark.medium
@pytest.mark.parametrize("file", [PLAIN, SKIPPING], ids=["plain", "skipping"])
def test_both_learn(file: Path, shared_tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    losses = loaded(file).train(shared_tiny, 1e9, most_steps=120)
    said = capsys.readouterr().out
    print(said)
    assert len(losses) == 120
    assert sum(losses[-10:]) < sum(losses[:10]) / 4
    match = re.fullmatch(
        r"[\d,]+ rays/s, 120 steps, PSNR ([\d.]+) dB on 3 test images\n"
        r"samples skipped of those \d+ a ray in the box: ([\d.]+)%\n",
        said,
    )
    assert match is not None
    assert float(match[1]) > 15
    assert float(match[2]) == 0 if file == PLAIN else float(match[2]) > 30


def test_as_a_script(tmp_path: Path, forks: Forks) -> None:
    data = write_tiny(tmp_path / "ball", size=8)
    code = "import runpy, sys; del sys.argv[0]; runpy.run_path(sys.argv[0], run_name='__main__')"
    done = forks.run(code, SKIPPING, "--data", data, "--seconds", 0.1)
    assert done.returncode == 0, done.stderr
    assert re.match(r"[\d,]+ rays/s, [1-9]\d* steps, PSNR [\d.]+ dB on 3 test images\n", done.stdout)

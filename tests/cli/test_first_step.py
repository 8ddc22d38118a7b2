"""The way to the first training step: what it must not import, since each of these takes a second or more."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.helpers import TINY_NGP

FIRST_STEP = """
import sys
from nerfloom.training.trainer import Trainer

train_step = Trainer.train_step

class Stepped(BaseException):
    pass

def first_step(self):
    train_step(self)
    print(*sys.modules, flush=True)
    raise Stepped

Trainer.train_step = first_step
from nerfloom.cli.train import main

words = sys.argv[1:]
for vis in ("none", "tensorboard"):
    sys.argv = ["ns-train", *words, "--vis", vis, "--timestamp", vis]
    try:
        main()
    except Stepped:
        pass
"""
"""A program that runs ns-train up to the end of its first step, twice, and prints the modules imported by then."""
SLOW = {
    "torch._dynamo", "torch._inductor", "torch.utils.tensorboard", "tensorboard", "tensorflow", "scipy", "matplotlib",
    "skimage", "sklearn", "pandas", "cv2", "trimesh", "viser", "jinja2", "pycolmap", "plotly", "torchvision", "lpips",
}  # fmt: skip
"""Modules that take long to import, and that the first step does not need."""


@pytest.mark.medium
def test_what_is_imported_before_the_first_step(shared_tiny: Path, tmp_path: Path) -> None:
    """Also with TensorBoard's files: what that alone imports comes after what is imported without."""
    words = ["instant-ngp", "--data", shared_tiny, "--output-dir", tmp_path, *TINY_NGP]
    done = subprocess.run(
        [sys.executable, "-c", FIRST_STEP, *map(str, words)],
        capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    without, with_files = (set(line.split()) for line in done.stdout.splitlines())
    for imported in (without, with_files):
        assert "nerfloom.training.step" in imported
        assert imported & SLOW == set()


REFUSED = """
import sys
from importlib.metadata import entry_points

name = sys.argv[0] = sys.argv[1]
del sys.argv[1]
(entry,) = entry_points(group="console_scripts", name=name)
try:
    entry.load()()
except SystemExit as end:
    print(end.code)
print(*sys.modules)
"""
"""A program that runs a command, and prints its exit status and what it has imported."""
PATHS = {
    "no data": ("ns-train", ["instant-ngp", "--data", "{0}/capturs"], "Did you mean 'capture'?"),
    "no output": ("ns-train", ["nerfacto", "--data", "{0}/capture", "--output-dir", "{0}/file/x"], "cannot write"),
    "no start": ("ns-train", ["nerfacto", "--data", "{0}/capture", "--load-checkpoint", "{0}/a.ckpt"], "no such file"),
    "no recipe": ("ns-train", ["--load-config", "{0}/recipe.yml"], "No such file"),
    "no run to resume": ("ns-train", ["--resume", "{0}/outputs/one/m/t1"], "No such file"),
    "the run's data": ("ns-train", ["--resume", "{0}/outputs"], "give its new location: --data DIR"),
    "no run": ("ns-eval", ["{0}/outputs/one/n"], "No such file"),
    "an empty folder": ("ns-viewer", ["{0}/capture"], "there is no run below it"),
    "no checkpoint": ("ns-eval", ["{0}/outputs"], "holds no checkpoint"),
    "no such checkpoint": ("ns-eval", ["{0}/outputs", "--load-checkpoint", "{0}/a.ckpt"], "there is no checkpoint"),
    "no run to render": ("ns-render", ["orbit", "{0}/nowhere", "--output-path", "{0}/a.gif"], "No such file"),
    "no such video": ("ns-render", ["orbit", "{0}/outputs", "--output-path", "{0}/a.avi"], "the extension must be"),
    "no run to export": ("ns-export", ["tsdf", "{0}/nowhere", "--output-dir", "{0}"], "No such file"),
    "no data to compare": ("ns-compare", ["--methods", "nerfacto", "--data", "{0}/x", "--max-seconds", "9"], "no such"),
    "no data for stress": ("ns-stress", ["nerfacto", "--data", "{0}/x"], "there is no such folder"),
}  # fmt: skip
"""Mistake in a path -> the command, its arguments, and words of the answer."""


@pytest.mark.parametrize("mistake", PATHS)
def test_a_wrong_path_is_refused_before_torch_is_imported(mistake: str, tmp_path: Path) -> None:
    name, words, answer = PATHS[mistake]
    (tmp_path / "capture").mkdir()
    (tmp_path / "file").touch()
    run = tmp_path / "outputs" / "one" / "m" / "t"
    run.mkdir(parents=True)
    (run / "config.yml").write_text(f"method: instant-ngp\ndata: {tmp_path / 'moved'}\n")
    before = sorted(tmp_path.rglob("*"))
    done = subprocess.run(
        [sys.executable, "-c", REFUSED, name, *(word.format(tmp_path) for word in words)],
        capture_output=True, text=True, cwd=tmp_path,
    )  # fmt: skip
    code, imported = done.stdout.splitlines()
    assert answer in done.stderr.splitlines()[-1]
    assert code in ("1", "2")
    assert not {"torch", "numpy"} & set(imported.split())
    assert sorted(tmp_path.rglob("*")) == before

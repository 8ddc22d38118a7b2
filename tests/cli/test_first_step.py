"""The way to the first training step: it must not import packages that take a second or more."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.helpers import TINY_NGP
from tests.forked import ROOT, Forks

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
def test_what_is_imported_before_the_first_step(shared_tiny: Path, tmp_path: Path, forks: Forks) -> None:
    """This holds with TensorBoard's files too: its own imports come after the others.

    Torch is imported from the start, and its own imports are not slow.
    """
    words = ["instant-ngp", "--data", shared_tiny, "--output-dir", tmp_path, *TINY_NGP, "--machine.num-threads", 1]
    done = forks.run(FIRST_STEP, *words)
    assert done.returncode == 0, done.stderr
    without, with_files = (set(line.split()) for line in done.stdout.splitlines())
    for imported in (without, with_files):
        assert "nerfloom.training.step" in imported
        assert imported & SLOW == set()


REFUSED = """
import json, sys
from tests.cli.helpers import called

for name, words, folder in json.load(sys.stdin):
    done = called(name, *words, folder=folder)
    imported = [module for module in ("torch", "numpy") if module in sys.modules]
    print(json.dumps([done.returncode, done.stderr, imported]))
"""
"""A program that runs commands, and prints exit status and output of each, and which of two packages are imported."""
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


def what_there_is(folder: Path) -> list[str]:
    """The files and folders below a folder."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def with_a_run(folder: Path) -> Path:
    """Write a folder for data, a file, and a run without a checkpoint and without its data."""
    (folder / "capture").mkdir()
    (folder / "file").touch()
    run = folder / "outputs" / "one" / "m" / "t"
    run.mkdir(parents=True)
    (run / "config.yml").write_text(f"method: instant-ngp\ndata: {folder / 'moved'}\n")
    return folder


Answer = tuple[int, str, list[str]]


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Answer, Path]]:
    """The answers to all mistakes, with their folders, by one process; its imports stay imported."""
    folders = {mistake: with_a_run(tmp_path_factory.mktemp("refused")) for mistake in PATHS}
    asked = [
        (name, [word.format(folders[mistake]) for word in words], str(folders[mistake]))
        for mistake, (name, words, _) in PATHS.items()
    ]
    words = [sys.executable, "-c", REFUSED]
    done = subprocess.run(words, input=json.dumps(asked), capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    found = zip(PATHS, map(json.loads, done.stdout.splitlines()), strict=True)
    return {mistake: ((status, said, imported), folders[mistake]) for mistake, (status, said, imported) in found}


@pytest.mark.parametrize("mistake", PATHS)
def test_a_wrong_path_is_refused_before_torch_is_imported(
    mistake: str, answers: dict[str, tuple[Answer, Path]], tmp_path: Path
) -> None:
    (status, said, imported), folder = answers[mistake]
    assert PATHS[mistake][2] in said.splitlines()[-1]
    assert status in (1, 2)
    assert imported == []
    assert what_there_is(folder) == what_there_is(with_a_run(tmp_path))

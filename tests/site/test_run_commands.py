"""Commands of the documents that take a run or make one do so, from end to end, on a tiny scene and in few steps."""

import json
import os
import re
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from importlib import import_module
from pathlib import Path

import pytest

from benchmarks import __main__ as ours
from nerfloom.cli.bench import KINDS
from tests.site.pages import PAGES, ROOT, commands, words_of
from tests.training.helpers import TINY

pytestmark = pytest.mark.slow
RUN = re.compile(r"outputs/\w+/([\w-]+)/TIME")
LEFT_OUT = re.compile(
    r"camera-path|ns-render time|--resume|--load-config|--vis|--help|--version|my-method|plain-grid|path/to/ring"
    r"| (nerfstudio|colmap|blender) --|eval-appearance half|outputs/blocks-|/balls"
)
"""Commands that need more than a tiny still scene: tests of their own have them."""
SMALL = {
    "--num-frames": "2", "--resolution": "16", "--texture-size": "64", "--target-num-faces": "200",
    "--fit-seconds": "1", "--max-images": "1", "--max-seconds": "20", "--max-num-iterations": "2", "--width": "32",
    "--height": "18",
}  # fmt: skip
"""Flags with exchanged values, so that a command takes seconds."""
ADDED = {
    "ns-train": ["--max-num-iterations", "2", "--vis", "none", "--max-eval-images", "1"],
    "orbit": ["--num-frames", "2"],
    "interpolate": ["--num-frames", "2"],
    "spiral": ["--num-frames", "2"],
    "pointcloud": ["--num-points", "500"],
    "marching-cubes": ["--resolution", "16", "--isosurface-threshold", "0.3"],
    "tsdf": ["--resolution", "16"],
    "web": ["--fit-seconds", "1"],
}
"""Flags that are added to a command, or to one of its kinds, where they are not given."""


def shown(*names: str) -> list[str]:
    """The commands of these names to run, each once."""
    pages = [page for page in PAGES if page.is_relative_to(ROOT / "docs") and page.stem != "figures"]
    found = {command.split("  ")[0] for page in pages for _, command in commands(page)}
    return sorted(c for c in found if c.split()[0] in names and not LEFT_OUT.search(c) and "--data DIR" not in c)


RUNNING = shown("ns-train", "ns-eval", "ns-render", "ns-export")
RUNS = (
    "outputs/all/instant-ngp/TIME outputs/all/gaussian-splatting/TIME exports/splat.ply exports/scene.levels "
    "exports/scene.octree --data path/to/lego"
)
MEASURED = {
    "kernels": "--samples 512 --repeats 1",
    "methods": "--data path/to/lego --max-seconds 1",
    "curves": "--data path/to/lego --methods instant-ngp kplanes --budgets 1 2 --seeds 1 --views 1 --plot-dir plots",
    "profile-step": "--data path/to/lego --steps 3 --max-seconds 2",
    "operations": "--methods instant-ngp --before 2 --steps 2 --output results/operations.json",
    "pose-refinement": "--seconds 1",
    "meshes": "--load-config outputs/all/instant-ngp/TIME --exports tsdf --resolutions 16 --output results/meshes.json",
    "frames": f"--runs {RUNS} --widths 20 --threads 1 --pictures 2 --output results/frames.json",
    "viewer": f"--runs {RUNS} --widths 32 --pictures 2",
}
"""Benchmark -> its flags for a second's work. The others run in tests/benchmarks."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, shared_tiny: Path) -> Path:
    """A working folder with the data sets and the runs that the documents name."""
    import nerfloom

    folder = tmp_path_factory.mktemp("site")
    for name in ("path/to/lego", "path/to/fox", "data/mine", "data/room", "data/blender/lego"):
        shutil.copytree(shared_tiny, folder / name)
    before = Path.cwd()
    os.chdir(folder)
    try:
        for method in ("instant-ngp", "nerfacto", "gaussian-splatting"):
            settings = {"max_num_iterations": 60, **TINY.get(method, {})}
            nerfloom.train(method, data="path/to/lego", vis="none", experiment_name="all", timestamp="TIME", **settings)
        execute(["ns-export", "gaussian-splat", "outputs/all/gaussian-splatting/TIME", "--output-dir", "exports"])
        execute(["ns-export", "levels", "exports/splat.ply", "--output-dir", "exports"])
        words = "--output-path exports/scene.octree --resolution 16 --fine-tune-seconds 0"
        execute(["ns-bake", "outputs/all/instant-ngp/TIME", *words.split()])
    finally:
        os.chdir(before)
    return folder


def execute(words: list[str]) -> None:
    scripts = dict(re.findall(r'^(ns-[\w-]+) = "(.+):main"$', (ROOT / "pyproject.toml").read_text(), re.MULTILINE))
    if words[:3] == ["python", "-m", "benchmarks"]:
        ours.main.__wrapped__(words[3:])
        return
    import_module(scripts[words[0]]).main.__wrapped__(words[1:])


def in_small(command: str) -> list[str]:
    """The words of a command with smaller values."""
    words = words_of(RUN.sub(r"outputs/all/\1/TIME", command))
    words = [SMALL.get(before, word) for before, word in zip(["", *words], words, strict=False)]
    for key in (words[0], words[1]):
        if (extra := ADDED.get(key)) and extra[0] not in words:
            words += extra
    return words


@pytest.mark.parametrize("command", RUNNING)
def test_it_runs_to_its_end(command: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    words = in_small(command)
    output = next((words[i + 1] for i, word in enumerate(words) if word in ("--output-path", "--output-dir")), None)
    before = set(folder.rglob("*"))
    if output is not None and output != "exports":
        shutil.rmtree(folder / output, ignore_errors=True)
        (folder / output).unlink(missing_ok=True)
    execute(words)
    if output is not None:
        assert (folder / output).exists()
    elif words[0] == "ns-train":
        assert any(path.suffix == ".ckpt" for path in set(folder.rglob("*")) - before)
    else:
        assert (folder / "outputs/all").exists()


@pytest.mark.parametrize("command", shown("ns-viewer"))
def test_the_viewer_answers(command: str, folder: Path) -> None:
    """It serves its page until it is told to stop."""
    pytest.importorskip("viser", reason="the extra viewer is not installed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    words = [word for word in words_of(RUN.sub(r"outputs/all/\1/TIME", command)) if not word.startswith("--websocket")]
    words = [word for word in words if word not in ("0.0.0.0", "8080")]
    program = [sys.executable, "-m", "nerfloom.cli.viewer", *words[1:], "--websocket-port", port]
    where = {**os.environ, "PYTHONPATH": str(ROOT)}
    viewer = subprocess.Popen(program, cwd=folder, env=where, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    try:
        for _ in range(240):
            time.sleep(0.25)
            assert viewer.poll() is None, viewer.stdout and viewer.stdout.read().decode()
            try:
                with urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=5) as page:
                    assert page.status == 200
                    return
            except OSError:
                continue
        pytest.fail("no answer after a minute")
    finally:
        viewer.terminate()
        viewer.wait(30)


@pytest.mark.parametrize("what", MEASURED)
def test_a_benchmark_writes_what_it_measured(what: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    (folder / "results").mkdir(exist_ok=True)
    for file in (folder / "results").iterdir():
        file.unlink()
    where = [] if "--output" in MEASURED[what] else ["--output-dir", "results"]
    program = ["ns-bench"] if what in KINDS else ["python", "-m", "benchmarks"]
    execute([*program, what, *MEASURED[what].split(), *where])
    (written,) = (folder / "results").glob("*.json")
    content = json.loads(written.read_text())
    assert content
    assert str(folder) not in written.read_text()  # nothing of this machine's folders


def test_enough_is_run() -> None:
    assert len(RUNNING) > 35
    benchmarks = [*KINDS, *ours.KINDS]
    elsewhere = {"gpu", "quadrature", "processes", "contention", "cache", "poses", "city"}
    assert set(benchmarks) - elsewhere <= set(MEASURED) | {"tables"}

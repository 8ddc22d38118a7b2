"""The documents' commands for photographs, videos and comparisons run to their end, on a corner of textured planes."""

import os
import re
import shutil
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from PIL import Image

from tests.processing.scene import write_corner
from tests.site.pages import ROOT, blocks, commands, words_of
from tests.site.test_run_commands import execute, in_small, shown

pytestmark = pytest.mark.slow
PICTURES = ("--data path/to/photographs", "--data walk.mp4")
PROCESSED = [c for c in shown("ns-process-data") if any(data in c for data in PICTURES) and "FISHEYE" not in c]
"""Commands that find poses from pictures. Exports of apps, and lenses, are read in tests/truth/test_processing.py."""
COMPARED = shown("ns-compare")


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory, shared_tiny: Path) -> Path:
    """A working folder with photographs, their masks, a video and a data set, as the documents name them."""
    folder = tmp_path_factory.mktemp("walk")
    write_corner(folder / "path/to/photographs")
    photographs = sorted((folder / "path/to/photographs").iterdir())
    (folder / "path/to/masks").mkdir()
    for file in photographs:
        Image.new("L", (320, 240), 255).save(folder / "path/to/masks" / file.name)
    frames = np.stack([np.asarray(Image.open(file)) for file in photographs])
    iio.imwrite(folder / "walk.mp4", frames, fps=10, quality=9)
    for name in ("lego", "fox"):
        shutil.copytree(shared_tiny, folder / "path/to" / name)
    shutil.copytree(ROOT / "configs", folder / "configs")
    return folder


@pytest.mark.parametrize("command", PROCESSED)
def test_poses_are_found(command: str, walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pycolmap")
    monkeypatch.chdir(walk)
    words = words_of(command)
    words[words.index("--output-dir") + 1] = str(tmp_path / "data")
    execute([word for word in words if word != "--overwrite"])
    assert (tmp_path / "data/transforms.json").is_file()


@pytest.mark.parametrize("command", COMPARED)
def test_methods_are_compared(command: str, walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(walk)
    few = {"--max-seconds": "20", "--repeats": "2"}
    words = words_of(command)
    words = [few.get(before, word) for before, word in zip(["", *words], words, strict=False)]
    execute([*words, "--max-num-iterations", "2", "--max-eval-images", "1", "--output-dir", str(tmp_path / "report")])
    report = (tmp_path / "report/report.md").read_text()
    methods = re.findall(r"(instant-ngp|nerfacto|kplanes|vanilla-nerf|gaussian-splatting)", command)
    assert all(name in report for name in methods or ["instant-ngp", "tensorf"])
    assert "failed" not in report


def test_the_first_capture_from_photographs_to_a_mesh(walk: Path, tmp_path: Path) -> None:
    """The guide's five commands one after the other, each with the files of the one before."""
    pytest.importorskip("pycolmap")
    page = ROOT / "docs/start/first-capture.md"
    (block,) = [block for block in blocks(page) if block.text.startswith("ns-process-data")]
    told = [command for where, command in commands(page) if where.split(":")[-1].isdigit() and command in block.text]
    assert [command.split()[0] for command in told] == [
        "ns-process-data", "ns-train", "ns-viewer", "ns-render", "ns-export",
    ]  # fmt: skip
    process, train, _, render, export = [words_of(command) for command in told]
    before = Path.cwd()
    os.chdir(tmp_path)
    try:
        shutil.copytree(walk / "path", tmp_path / "path")
        execute(process)
        execute(
            [*train, "--max-num-iterations", "30", "--vis", "none", "--max-eval-images", "1", "--timestamp", "TIME"]
        )
        execute([*render, "--num-frames", "4", "--downscale-factor", "4"])
        execute([*export, "--resolution", "32"])
    finally:
        os.chdir(before)
    assert iio.improps(tmp_path / "walk.mp4", plugin="FFMPEG").shape[0] > 0
    assert len(list((tmp_path / "exports").iterdir())) >= 1


def test_what_is_run_here_is_most_of_what_is_shown() -> None:
    assert len(PROCESSED) >= 5
    assert len(COMPARED) >= 4
    assert in_small("ns-train instant-ngp --max-seconds 300")[-1] == "1"

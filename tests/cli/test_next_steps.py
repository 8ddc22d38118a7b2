"""The commands that a training prints at its end: they suit the run and its data."""

import shlex
from dataclasses import replace
from pathlib import Path

import torch

from nerfloom.cli.session import after_training
from nerfloom.data.scene import Scene
from nerfloom.processing.output import ready

OBJECT = Scene(
    torch.tensor([[-1.0] * 3, [1.0] * 3]), 0.1, 6.0, num_cameras=10, has_alpha=True, moving=False, image_size=200
)


def commands(scene: Scene, folder: str = "outputs/mine/nerfacto/1") -> list[list[str]]:
    """The words of each command."""
    first, *lines = after_training(scene, Path(folder))
    assert first == "next:"
    return [shlex.split(line.partition(":  ")[2]) for line in lines]


def test_the_path_suits_the_scene() -> None:
    assert commands(OBJECT)[1][:3] == ["ns-render", "orbit", "outputs/mine/nerfacto/1"]
    assert commands(replace(OBJECT, unbounded=True))[1][1] == "interpolate"
    assert commands(replace(OBJECT, unbounded=True, warped=True))[1][1] == "spiral"
    assert [words[0] for words in commands(OBJECT)] == ["ns-viewer", "ns-render", "ns-export", "ns-eval"]
    assert [words[0] for words in commands(replace(OBJECT, warped=True))] == ["ns-viewer", "ns-render", "ns-eval"]
    assert [words[0] for words in commands(replace(OBJECT, num_scenes=3))] == ["ns-eval"]


def test_a_folder_with_a_space_is_quoted() -> None:
    assert all("my cup/run" in words for words in commands(OBJECT, "my cup/run"))
    assert shlex.split(ready(Path("my cup")).partition("next: ")[2])[:4] == [
        "ns-train", "gaussian-splatting", "--data", "my cup",
    ]  # fmt: skip

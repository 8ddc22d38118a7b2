"""Frames on disk: a stopped render goes on, and no frame of another is taken."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from nerfloom.base.errors import ConfigError
from nerfloom.evaluation import frames as kept_frames
from nerfloom.evaluation.frames import Frames, hash_of_file, hash_of_tensors, key_of, open_frames
from nerfloom.evaluation.outputs import Arrays


class Renderer:
    """Frames of one grey each; stops at a frame."""

    def __init__(self, stop: int | None = None) -> None:
        self.stop = stop
        self.rendered: list[int] = []

    def __call__(self, index: int) -> Arrays:
        if index == self.stop:
            raise KeyboardInterrupt
        self.rendered.append(index)
        return {"rgb": np.full((2, 2, 3), index, np.uint8), "depth": np.full((2, 2), index / 3, np.float32)}


@pytest.mark.parametrize("limit", [kept_frames.MAX_PLAIN, 0])
def test_a_stopped_render_goes_on(
    limit: int, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames as they are, and compressed ones. They are not flushed, so a loss of power leaves damaged ones."""
    monkeypatch.setattr(kept_frames, "MAX_PLAIN", limit)
    facts = {"run": "a", "num_frames": 5}
    first, second = Renderer(stop=4), Renderer()
    opened, flushed = open_frames(tmp_path / "a.gif", 5, facts), list[int]()
    monkeypatch.setattr(os, "fsync", flushed.append)
    with pytest.raises(KeyboardInterrupt):
        opened.render(first)
    assert not flushed
    assert "4 of 5 frames are in" in capsys.readouterr().err
    frames = open_frames(tmp_path / "a.gif", 5, dict(reversed(facts.items())))
    whole = [frames.path(index).read_bytes() for index in range(3)]
    frames.path(0).write_bytes(bytes(len(whole[0])))
    frames.path(1).write_bytes(whole[1][:100])
    frames.path(2).write_bytes(whole[2].replace(np.float32(2 / 3).tobytes(), bytes(4)) if limit else b"")
    frames.render(second)
    assert "1 of 5 frames already exist" in capsys.readouterr().err
    assert (first.rendered, second.rendered) == ([0, 1, 2, 3], [0, 1, 2, 4])
    for index, kept in enumerate(frames):
        assert kept["rgb"].tolist() == [[[index] * 3] * 2] * 2
        assert kept["depth"].dtype == np.float32
        assert kept["depth"][0, 0] == np.float32(index / 3)
    frames.remove()
    assert list(tmp_path.iterdir()) == []


def test_frames_of_another_render_are_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(KeyboardInterrupt):
        open_frames(tmp_path / "a.gif", 5, {"run": "a"}).render(Renderer(stop=2))
    other = open_frames(tmp_path / "a.gif", 5, {"run": "b"})
    assert "has frames of another render" in capsys.readouterr().err
    renderer = Renderer()
    other.render(renderer)
    assert renderer.rendered == list(range(5))
    other.remove()
    again = Renderer()
    open_frames(tmp_path / "a.gif", 5, {"run": "a"}).render(again)
    assert again.rendered == [2, 3, 4]


def test_a_frame_that_is_missing_when_files_are_written(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"000000.npz .*same command"):
        list(Frames(tmp_path, 1))


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "a.gif.frames").touch()
    with pytest.raises(ConfigError, match=r"cannot write .*; use another path"):
        open_frames(tmp_path / "a.gif", 1, {})


def test_keys_and_hashes_are_those_of_the_content(tmp_path: Path) -> None:
    assert key_of({"a": 1, "b": [2]}) == key_of({"b": [2], "a": 1}) != key_of({"a": 1, "b": [3]})
    (tmp_path / "file").write_bytes(b"abc")
    assert hash_of_file(tmp_path / "file") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    one = torch.arange(6.0)
    assert hash_of_tensors(one, None) == hash_of_tensors(one.clone(), None)
    others = (one.view(2, 3), one.double(), one + 1e-6)
    assert len({hash_of_tensors(value, None) for value in (one, *others)} | {hash_of_tensors(None, one)}) == 5

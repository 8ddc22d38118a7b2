"""Images on the device, as bytes, where they fit; else batches are copied, of the same pixels."""

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
import torch

from nerfloom.data.dataset import Dataset, load_dataset
from nerfloom.data.pixels import device_placement
from nerfloom.data.pixels.batch import PixelBatch, draw_batch, draw_pixels
from nerfloom.data.pixels.device_placement import on_device
from nerfloom.data.pixels.pixel_set import PixelSet
from nerfloom.data.sparse_depth import SparseDepth
from nerfloom.dataparsers.blender import Blender

ELSEWHERE = torch.device("meta")
"""A device that has no values, in place of a GPU."""


@pytest.fixture
def dataset(shared_tiny: Path) -> Dataset:
    found = load_dataset(Blender().parse(shared_tiny, "train"), "train")
    return replace(found, drawn=PixelSet.of_runs(torch.tensor([3, 90]), torch.tensor([50, 200])).listed())


def tensors(value: Any) -> dict[str, torch.Tensor]:
    """All tensors in a batch, by name."""
    found = {}
    for field in fields(value):
        part = getattr(value, field.name)
        if isinstance(part, torch.Tensor):
            found[field.name] = part
        elif field.name == "rays":
            found |= tensors(part)
    return found


@pytest.mark.parametrize("case", ["plain", "keypoints", "cut out"])
def test_batches_that_are_copied_have_the_same_bits(dataset: Dataset, case: str, monkeypatch: Any) -> None:
    keypoints = 0
    if case == "keypoints":
        known = SparseDepth(torch.tensor([4, 77, 300]), torch.rand(3) + 1, torch.rand(3))
        dataset, keypoints = replace(dataset, sparse_depth=known), 5
    if case == "cut out":
        dataset = replace(dataset, opaque=PixelSet.of_runs(torch.tensor([0]), torch.tensor([60])))

    def drawn() -> PixelBatch:
        torch.manual_seed(7)
        return draw_batch(dataset, 64, "random", keypoints=keypoints)

    here = tensors(drawn())
    monkeypatch.setattr(Dataset, "resident", property(lambda self: False))
    copied = tensors(drawn())
    assert here.keys() == copied.keys()
    assert all(torch.equal(value, copied[name]) for name, value in here.items())
    assert len(here["rgb"].unique()) > 10


@pytest.mark.parametrize("room", [2.01, 1.99])
def test_images_go_to_the_device_as_bytes_if_they_take_half_of_its_room(
    dataset: Dataset, room: float, monkeypatch: Any
) -> None:
    assert dataset.drawn is not None
    assert dataset.drawn.every is not None
    size = dataset.pixels.numel() + 4 * len(dataset.drawn)
    monkeypatch.setattr(device_placement, "free_memory", lambda device: room * size)
    moved, line = on_device(dataset, ELSEWHERE)
    fits = room > 2
    assert moved.resident == fits
    assert moved.device == ELSEWHERE
    assert moved.pixels.dtype == torch.uint8
    assert moved.drawn is not None
    assert moved.pixels.device.type == moved.drawn.starts.device.type == ("meta" if fits else "cpu")
    assert line is not None
    assert ("8 bits a channel" in line) == fits
    assert ("stay in the machine's memory" in line) != fits
    if not fits:  # pixels are drawn where they are, and copied
        assert draw_pixels(moved, 5).device.type == "cpu"
        assert draw_batch(moved, 5, "white").rgb.device == ELSEWHERE


def test_on_the_cpu_nothing_is_said_and_nothing_is_copied(dataset: Dataset) -> None:
    moved, line = on_device(dataset, torch.device("cpu"))
    assert line is None
    assert moved.pixels is dataset.pixels

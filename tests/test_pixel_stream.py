"""Reading ahead: the same batches as from memory, drawn evenly, however far is read and wherever a run begins."""

from functools import partial
from pathlib import Path

import pytest
import torch
from scipy import stats

from nerfloom.base.device import seed_step
from nerfloom.data.dataset import Dataset, load_dataset
from nerfloom.data.pixels.batch import PixelBatch, draw_batch, draw_pixels
from nerfloom.data.pixels.cache import PixelMemory
from nerfloom.data.pixels.pixel_set import PixelSet
from nerfloom.data.pixels.stream import PixelStream
from nerfloom.dataparsers.blender import Blender
from nerfloom.training.checkpoint import load_checkpoint
from tests.images import write_noise
from tests.training.helpers import assert_same_bits, tensors, tiny_trainer

SEED = 7
STEPS = 30
"""Number of steps of the runs."""


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Dataset, Dataset]:
    """The same images with alpha in memory and in a file."""
    folder = tmp_path_factory.mktemp("stream")
    scene = write_noise(folder / "images", [(20, 10), (7, 30), (16, 16)], channels=4, suffix=".png")
    return load_dataset(scene, "train"), load_dataset(scene, "train", PixelMemory(0, folder / "cache"))


def batch(data: Dataset, step: int, count: int, stream: PixelStream | None) -> PixelBatch:
    seed_step(SEED, step)
    look_up = None if stream is None else partial(stream.look_up, step)
    return draw_batch(data, count, "random", look_up=look_up)


def assert_same(one: PixelBatch, two: PixelBatch) -> None:
    assert torch.equal(one.pixels, two.pixels)
    assert torch.equal(one.rgb, two.rgb)
    assert torch.equal(one.rays.directions, two.rays.directions)
    assert one.alpha is not None
    assert two.alpha is not None
    assert torch.equal(one.alpha, two.alpha)


def test_batches_are_those_from_memory_whatever_their_sizes(both: tuple[Dataset, Dataset]) -> None:
    """Batches grow, shrink, are larger than the block read ahead, and come out of order."""
    here, there = both
    stream = PixelStream(there, SEED)
    sizes = [100, 100, 101, 400, 399, 3, 2, 1, 5000, 50, *range(60, 160, 2)]
    for step, size in enumerate(sizes):
        assert_same(batch(here, step, size, None), batch(there, step, size, stream))
    for step in (3, 200, 201, 0, 10_000):
        assert_same(batch(here, step, 77, None), batch(there, step, 77, stream))


def test_batches_of_some_pixels_only(both: tuple[Dataset, Dataset]) -> None:
    chosen = PixelSet.of_mask(torch.rand(len(both[0].pixels)) < 0.3)
    here, there = (data.drawing(chosen) for data in both)
    stream = PixelStream(there, SEED)
    for step in range(30):
        theirs = batch(there, step, 90, stream)
        assert_same(batch(here, step, 90, None), theirs)
        assert bool(chosen.mask(0, len(here.pixels))[theirs.pixels].all())


def test_memory_for_a_single_step_is_enough(both: tuple[Dataset, Dataset]) -> None:
    here, there = both
    stream = PixelStream(there, SEED)
    stream.capacity = 10
    for step in range(12):
        assert_same(batch(here, step, 35, None), batch(there, step, 35, stream))


def test_without_a_stream_the_file_is_read_at_random(both: tuple[Dataset, Dataset]) -> None:
    here, there = both
    assert_same(batch(here, 0, 500, None), batch(there, 0, 500, None))
    with pytest.raises(ValueError, match="in memory"):
        PixelStream(here, SEED)


def test_pixels_are_even_and_independent_within_and_between_batches(both: tuple[Dataset, Dataset]) -> None:
    """Chi-square of pixels, and of pairs of images drawn next to each other and in the same place of the next step."""
    there, steps, count = both[1], 150, 400
    drawn = []
    for step in range(steps):
        seed_step(SEED, step)
        drawn.append(draw_pixels(there, count))
    pixels = torch.stack(drawn)
    assert stats.chisquare(torch.bincount(pixels.reshape(-1), minlength=len(there.pixels)).numpy()).pvalue > 1e-3
    images = torch.searchsorted(there.cameras.offsets, pixels, right=True) - 1
    for first, second in ((images[:, ::2], images[:, 1::2]), (images[::2], images[1::2])):
        pairs = torch.bincount((first * 3 + second).reshape(-1), minlength=9).view(3, 3)
        assert stats.chi2_contingency(pairs.numpy()).pvalue > 1e-3
    repeats = sum(len(row) - len(row.unique()) for row in pixels) / steps  # drawn with replacement
    total = len(there.pixels)
    assert repeats == pytest.approx(count - total * (1 - (1 - 1 / total) ** count), rel=0.05)


def test_what_a_step_draws_first_does_not_depend_on_how_many_it_draws(both: tuple[Dataset, Dataset]) -> None:
    """Reading ahead depends on this: torch's generator on the CPU fills in order."""
    for total in (1000, 5 * 10**9):
        few, many = (torch.randint(total, (n,), generator=torch.Generator().manual_seed(3)) for n in (1000, 70_001))
        torch.manual_seed(3)
        assert torch.equal(few, many[:1000])
        assert torch.equal(few, torch.randint(total, (1000,)))


@pytest.mark.medium
@pytest.mark.parametrize("changes", [{}, {"robust": "errors"}, {"silhouette_cells": False}])
def test_a_run_from_a_file_is_the_run_from_memory(shared_tiny: Path, tmp_path: Path, changes: dict) -> None:
    settings = {"max_num_iterations": STEPS, "cache_dir": tmp_path / "cache", **changes}
    here = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "here", **settings)
    there = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "there", cache_limit=0.0, **settings)
    assert there.train_set.mapped is not None
    assert here.profile.as_plain() == there.profile.as_plain()
    here.train()
    there.train()
    assert_same_bits(tensors(here), tensors(there))
    assert here.state.rays == there.state.rays


@pytest.fixture(scope="module")
def uninterrupted(shared_tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, torch.Tensor]:
    """Parameters of a run from a file."""
    folder = tmp_path_factory.mktemp("uninterrupted")
    settings = {"max_num_iterations": STEPS, "cache_dir": folder / "cache", "cache_limit": 0.0}
    whole = tiny_trainer("instant-ngp", shared_tiny, folder / "whole", **settings)
    whole.train()
    return tensors(whole)


@pytest.mark.medium
@pytest.mark.parametrize("interrupted", [1, 23])
def test_a_resumed_run_is_an_uninterrupted_one(
    shared_tiny: Path, tmp_path: Path, interrupted: int, uninterrupted: dict[str, torch.Tensor]
) -> None:
    settings = {"max_num_iterations": STEPS, "cache_dir": tmp_path / "cache", "cache_limit": 0.0}
    first = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "first", **settings)
    for _ in range(interrupted):
        first.train_step()
    checkpoint = first.save()
    second = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "second", **settings)
    second.restore(load_checkpoint(checkpoint))
    second.train()
    assert_same_bits(uninterrupted, tensors(second))


def test_reading_drops_what_lies_behind(tmp_path: Path) -> None:
    """Every byte is read, slice by slice; each slice is let go of."""
    scene = write_noise(tmp_path / "images", [(1000, 800)] * 3)
    data = load_dataset(scene, "train", PixelMemory(0, tmp_path / "cache"))
    mapped = data.mapped
    assert mapped is not None
    dropped: list[tuple[int, int]] = []
    mapped.drop = lambda first=0, last=None: dropped.append((first, last or 0))  # type: ignore[method-assign]
    flat = torch.randint(len(data.pixels), (5000,))
    assert torch.equal(mapped.look_up(flat), data.pixels[flat])
    assert len(dropped) >= 3 * 3 * 800_000 // mapped.slice
    assert all(0 < (last - first) * 3 <= mapped.slice for first, last in dropped)
    everywhere = PixelSet.of_mask(torch.cat([torch.arange(a, b) for a, b in dropped]).bincount() > 0)
    assert bool(everywhere.mask(0, len(data.pixels))[flat].all())


def test_methods_of_other_formats_are_not_disturbed(shared_tiny: Path) -> None:
    data = load_dataset(Blender().parse(shared_tiny, "train"), "train")
    assert data.mapped is None
    assert data.kept is None
    assert data.drawn is None

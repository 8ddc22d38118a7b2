"""A run begins with a few of its held-out images, and loads the others when it evaluates all."""

from pathlib import Path

import pytest

from nerfloom.training.datasets import first_split, load_split
from nerfloom.training.trainer import Trainer
from tests.training.helpers import tiny_run


def test_a_few_are_evenly_spaced_and_the_same_images(shared_tiny: Path, tmp_path: Path) -> None:
    run = tiny_run("instant-ngp", shared_tiny, tmp_path)
    whole, few = load_split(run, "train"), load_split(run, "train", 2)
    assert len(whole) > 3
    assert few.names == (whole.names[0], whole.names[len(whole) // 2])
    for index, name in enumerate(few.names):
        assert few.image(index).equal(whole.image(whole.names.index(name)))
    assert len(load_split(run, "train", 100)) == len(whole)


def test_all_are_loaded_once_where_all_are_evaluated(shared_tiny: Path, tmp_path: Path) -> None:
    run = tiny_run("instant-ngp", shared_tiny, tmp_path, max_num_iterations=4, steps_per_eval_all_images=2)
    trainer = Trainer.of(run, load_split(run, "train"), first_split(run, ("val", "test"), 1))
    loaded = []

    def load_all():  # type: ignore[no-untyped-def]
        loaded.append(trainer.state.step)
        return first_split(run, ("val", "test"))

    trainer.held_out.load_all = load_all
    trainer.train()
    assert loaded == [2]
    assert [point[4] for point in trainer.state.curve] == [len(load_split(run, "val"))] * 2


@pytest.mark.parametrize("count", [1, 2])
def test_without_a_loader_those_given_are_all(count: int, shared_tiny: Path, tmp_path: Path) -> None:
    run = tiny_run("instant-ngp", shared_tiny, tmp_path, max_num_iterations=2, steps_per_eval_all_images=2)
    trainer = Trainer.of(run, load_split(run, "train"), load_split(run, "val", count))
    trainer.train()
    assert [point[4] for point in trainer.state.curve] == [count]

"""Threads that die at their work: whoever waits for them is told, and nobody waits for ever."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfloom.data.dataset import load_dataset
from nerfloom.data.pixels.batch import draw_pixels
from nerfloom.data.pixels.cache import PixelMemory
from nerfloom.data.pixels.memory_mapped import MappedPixels
from nerfloom.data.pixels.stream import FIRST_STEPS, PixelStream
from nerfloom.training.checkpoint import list_checkpoints, load_checkpoint
from tests.images import write_noise
from tests.patience import PATIENCE
from tests.training.helpers import tiny_trainer


def error_of(work: Callable[[], object]) -> BaseException | None:
    """The error of some work. A test fails if it does not end."""
    raised: list[BaseException] = []

    def attempt() -> None:
        try:
            work()
        except BaseException as error:
            raised.append(error)

    thread = threading.Thread(target=attempt, daemon=True)
    thread.start()
    thread.join(PATIENCE)
    assert not thread.is_alive(), "it hangs"
    return raised[0] if raised else None


def test_a_program_trains_in_a_thread_of_its_own(shared_tiny: Path, tmp_path: Path) -> None:
    """As servers and graphical programs do; only the main thread may handle signals."""
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=2)
    assert error_of(trainer.train) is None
    assert [path.name for path in list_checkpoints(trainer.checkpoint_folder)] == ["step-000000002.ckpt"]


class Dying:
    """`MappedPixels.take` that works for a while."""

    def __init__(self, mapped: MappedPixels, calls: int, error: BaseException) -> None:
        self.take, self.calls, self.error = mapped.take, calls, error
        self.threads: set[str] = set()

    def __call__(self, flat: np.ndarray) -> np.ndarray:
        self.threads.add(threading.current_thread().name)
        self.calls -= 1
        if self.calls < 0:
            raise self.error
        return self.take(flat)


@pytest.mark.parametrize("error", [MemoryError("no memory"), OSError(5, "Input/output error"), SystemExit(1)])
@pytest.mark.parametrize("calls", [0, 1, 2])
def test_a_reader_of_pixels_that_dies_is_heard_of(error: BaseException, calls: int, tmp_path: Path) -> None:
    """It dies at once, during the first steps, or in the middle: the step that needs the unread pixels reports it."""
    scene = write_noise(tmp_path / "images", [(20, 10), (16, 16)])
    data = load_dataset(scene, "train", PixelMemory(0, tmp_path / "cache"))
    assert data.mapped is not None
    dying = Dying(data.mapped, calls, error)
    data.mapped.take = dying  # type: ignore[method-assign]
    stream, steps = PixelStream(data, 0), []

    def work() -> None:
        for step in range(100):
            stream.look_up(step, draw_pixels(data, 50))
            steps.append(step)

    assert error_of(work) is error
    assert len(steps) == (0, FIRST_STEPS, 3 * FIRST_STEPS)[calls]
    assert all(name.startswith("pixels") for name in dying.threads)
    assert error_of(lambda: stream.look_up(len(steps), draw_pixels(data, 50))) is error  # and whoever asks again


def test_training_ends_with_the_error_and_what_was_saved_stands(shared_tiny: Path, tmp_path: Path) -> None:
    settings = {"cache_limit": 0.0, "cache_dir": tmp_path / "cache"}
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", **settings)
    for _ in range(2):
        trainer.train_step()
    saved, error = trainer.save(), MemoryError("no memory")
    assert trainer.train_set.mapped is not None
    trainer.train_set.mapped.take = Dying(trainer.train_set.mapped, 0, error)  # type: ignore[method-assign]
    assert error_of(lambda: [trainer.train_step() for _ in range(1000)]) is error
    assert load_checkpoint(saved)["state"]["step"] == 2


@pytest.mark.parametrize("limit", [0.0, 1e9])
def test_a_decoder_that_dies_is_heard_of_and_leaves_nothing(
    limit: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = write_noise(tmp_path / "images", [(20, 10)] * 20)
    error = MemoryError("no memory")

    def die(*_: Any) -> None:
        raise error

    monkeypatch.setattr("nerfloom.data.decoding.light_of", die)
    assert error_of(lambda: load_dataset(scene, "train", PixelMemory(limit, tmp_path / "cache"))) is error
    assert not (tmp_path / "cache").exists() or list((tmp_path / "cache").iterdir()) == []

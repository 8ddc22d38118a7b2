"""The viewer beside training: the result has the same bits, and nothing is drawn without a client."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from nerfloom.training.progress import StepReport
from nerfloom.viewer.browser import Browser
from nerfloom.viewer.render_queue import RenderQueue
from nerfloom.viewer.request import Request, pose_of
from nerfloom.viewer.training_viewer import Turns, in_training
from tests.training.helpers import TINY, assert_same_bits, tensors, tiny_run, tiny_trainer

KINDS = [
    pytest.param(kind, marks=() if kind in ("instant-ngp", "gaussian-splatting") else pytest.mark.slow) for kind in TINY
]
STEPS = 40


def looking(number: int, pictures: list[np.ndarray], queue: RenderQueue, x: float) -> None:
    """A browser that looks from some place."""
    queue.add(number, Browser(lambda image, quality: pictures.append(image)))
    pose = pose_of((1, 0, 0, 0), (x, 0, -4), 0.7)
    assert pose is not None
    moving = queue.loaded.model.scene.moving
    queue.ask(number, lambda _: Request(pose, 40, 30, "depth" if number else "rgb", 0.5 if moving else None))


@pytest.mark.medium
@pytest.mark.usefixtures("even_clock")  # on a busy machine one picture might take the share of all steps
@pytest.mark.parametrize("kind", KINDS)
def test_the_same_bits_with_and_without(kind: str, shared_tiny: Path, tmp_path: Path) -> None:
    plain = tiny_trainer(kind, shared_tiny, tmp_path / "plain", max_num_iterations=STEPS)
    plain.train()

    watched = tiny_trainer(kind, shared_tiny, tmp_path / "watched", max_num_iterations=STEPS)
    queue = RenderQueue(in_training(tiny_run(kind, shared_tiny, tmp_path / "watched"), watched), 0.01, 0.01)
    turns, pictures = Turns(watched, queue, share=0.9), list[np.ndarray]()

    def between_steps(report: StepReport, stopped: list[int]) -> None:
        if report.step % 3 == 0:
            looking(report.step % 2, pictures, queue, 0.01 * report.step)
        turns.take(report, stopped)

    watched.train(between_steps)  # type: ignore[arg-type]
    assert len(pictures) >= 5
    assert watched.state.step == STEPS
    assert_same_bits(tensors(watched), tensors(plain))
    assert watched.state.train_mse == plain.state.train_mse


def test_nothing_is_drawn_for_nobody(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=20)
    queue = RenderQueue(in_training(tiny_run("instant-ngp", shared_tiny, tmp_path / "run"), trainer))
    turns = Turns(trainer, queue, share=0.5)
    trainer.train(turns.take)
    assert turns.waited == 0


def test_a_pause_ends_by_the_button_or_by_a_signal(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=20)
    queue = RenderQueue(in_training(tiny_run("instant-ngp", shared_tiny, tmp_path / "run"), trainer), 0.01, 0.01)
    turns, pictures = Turns(trainer, queue, share=0.1), list[np.ndarray]()

    report = trainer.train_step()
    before = dataclasses.replace(trainer.state)
    looking(0, pictures, queue, 0.0)
    waits = 0

    def wait(_: float) -> None:
        nonlocal waits
        waits += 1
        turns.paused = waits < 3

    queue.wait = wait  # type: ignore[method-assign]
    turns.paused = True
    turns.take(report, [])
    assert waits == 3
    assert pictures  # while training rests, pictures are drawn as fast as they can be
    assert dataclasses.asdict(trainer.state) == dataclasses.asdict(before)
    turns.paused = True
    turns.take(report, [2])  # Ctrl-C
    assert waits == 3

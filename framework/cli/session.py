"""A training session from start to end: data, training, final evaluation, and what is printed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from framework.base.console import say
from framework.base.device import choose_device, peak_memory
from framework.evaluation.evaluator import evaluate
from framework.training.checkpoint import FOLDER, list_checkpoints, load_newest
from framework.training.datasets import first_split, load_split
from framework.training.lock import sole_user
from framework.training.machine import kernels
from framework.training.report import write_evaluation, write_summary
from framework.training.run import Run, create_folder, write_report, write_transforms
from framework.training.signals import Stopped, signal_of
from framework.training.skipping import as_plain, lines, skip_report
from framework.training.trainer import Outcome, Trainer

PICTURES = 4
FEW_PIXELS = 16
"""Pixels of an image's longer side below which something went wrong with the images."""


def start(run: Run) -> None:
    """Train a new run.

    Raises: Stopped where somebody ends it; what was saved is said.
    """
    trainer = _prepare(run)
    run = trainer.run  # with what was decided
    trainer.restore_as_configured()
    with sole_user(run.folder):
        create_folder(run)
        _finish(run, trainer)


def resume(run: Run) -> None:
    """Go on with a run from its newest checkpoint; from the beginning where it has none. Raises as `start`."""
    with sole_user(run.folder):
        trainer = _prepare(run)
        checkpoint = load_newest(run.folder / FOLDER, trainer.device)
        if checkpoint is None:
            trainer.restore_as_configured()
            say(f"{run.folder} has no checkpoint: starting from the beginning")
        else:
            trainer.restore(checkpoint)
            say(f"resuming {run.folder} at step {trainer.state.step:,}")
        _finish(run, trainer)


def _prepare(run: Run) -> Trainer:
    device = choose_device(run.config.machine)
    train_set = load_split(run, "train").to(device)
    eval_set = first_split(run, ("val", "test"))
    source = run.config.data or "the embedded scene"
    say(f"{run.method} on {source} ({run.dataparser}), on {device.type}, kernels: {kernels(device)}")
    trainer = Trainer(run, train_set, None if eval_set is None else eval_set.to(device))
    for line in trainer.profile().lines():
        say(line)
    if train_set.scene.image_size < FEW_PIXELS:
        say(f"warning: images of {train_set.scene.image_size} pixels show next to nothing; are they thumbnails?")
    say(f"{trainer.model.size():,} parameters; writing to {run.folder}")
    return trainer


def _finish(run: Run, trainer: Trainer) -> None:
    # Also of a run that goes on: it may have been killed before it came to this.
    write_transforms(run, trainer.train_set)
    if trainer.first_step == 0:  # later there is nothing left to decide
        write_report(run.folder / "scene_profile.json", trainer.profile().as_plain())
    with _saying_of_a_stop(lambda: _what_is_saved(trainer)):
        outcome = trainer.train()
    state = trainer.state
    say(
        f"{outcome.reason}: step {state.step:,}, {state.seconds:.1f} s of training, "
        f"{state.rays / max(state.seconds, 1e-9) / 1e3:.1f}k rays/s, "
        f"{peak_memory(trainer.device) / 2**30:.2f} GiB at most"
        + (f", {state.skipped} steps skipped as not finite" if state.skipped else "")
    )
    rungs = skip_report(trainer)
    for line in lines(rungs):
        say(line)
    write_report(run.folder / "skip_report.json", as_plain(rungs))
    write_summary(trainer, outcome)
    say(f"checkpoint: {outcome.checkpoint}")
    if outcome.stopped_by is not None:
        raise Stopped(outcome.stopped_by, f"continue with: ns-train --resume {run.folder}")
    with _saying_of_a_stop(lambda: f"stopped while evaluating; the trained run is saved: ns-eval {run.folder}"):
        _evaluate(run, trainer, outcome)


def _evaluate(run: Run, trainer: Trainer, outcome: Outcome) -> None:
    test_set = first_split(run, ("test", "val"))
    if test_set is None or run.config.max_eval_images == 0:
        return
    found = evaluate(
        trainer.model,
        test_set.to(trainer.device),
        max_images=run.config.max_eval_images,
        pictures=run.folder / "pictures",
        max_pictures=PICTURES,
    )
    say(f"test: {found.line()}")  # first of all, for what follows needs room on the disk
    if found.pictures_note is None:
        say(f"pictures (photograph, render, error, depth, opacity): {run.folder / 'pictures'}")
    else:
        say(f"warning: {found.pictures_note}")
    write_evaluation(run.folder / "eval.json", run, outcome.checkpoint, found, trainer.device)
    say(f"evaluate again with: ns-eval --load-config {run.config_path}")


@contextmanager
def _saying_of_a_stop(note: Callable[[], str]) -> Iterator[None]:
    """Where a signal ends what is done meanwhile, say what came of it."""
    try:
        yield
    except KeyboardInterrupt as stop:
        raise Stopped(signal_of(stop), note()) from None


def _what_is_saved(trainer: Trainer) -> str:
    """Say what is saved of a run that is ended at once."""
    saved = list_checkpoints(trainer.checkpoint_folder)
    if not saved:
        return "stopped at once: nothing was saved"
    return f"stopped at once: {saved[-1].name} is what was saved; continue with: ns-train --resume {trainer.run.folder}"

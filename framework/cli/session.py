"""Training from start to end: data, training, final evaluation, and the printed lines."""

from __future__ import annotations

import shlex
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path

import torch

from nerfloom.base.console import say
from nerfloom.base.counts import counted
from nerfloom.base.device import choose_device, peak_memory
from nerfloom.base.errors import LostProcessError
from nerfloom.base.extras import require
from nerfloom.base.processes import from_first, joined_processes, processes
from nerfloom.base.signals import Stopped, handled, signal_of
from nerfloom.cli.common import check_weights
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.device_placement import on_device
from nerfloom.data.scene import Scene
from nerfloom.evaluation.evaluator import evaluate
from nerfloom.evaluation.video_suffixes import default_video
from nerfloom.model import StartsFromImages
from nerfloom.renderable import with_refined_poses
from nerfloom.splats.gaussians import HasGaussians
from nerfloom.training.budget import evaluation_seconds
from nerfloom.training.checkpoint import FOLDER, list_checkpoints, load_newest
from nerfloom.training.curve import MAX_IMAGES
from nerfloom.training.datasets import first_split, load_split
from nerfloom.training.lock import sole_user
from nerfloom.training.machine import kernels
from nerfloom.training.outcome import Outcome
from nerfloom.training.report import SUMMARY, write_evaluation, write_summary
from nerfloom.training.run import Run, create_folder, with_own_folder, write_report, write_transforms
from nerfloom.training.skipping import as_plain, lines, skip_report
from nerfloom.training.trainer import BetweenSteps, Trainer

MAX_PICTURES = 4
"""Maximum number of held-out views with pictures written at the end."""
MAX_TRAINING = 3
"""Maximum number of training images with pictures, if the method shows content of single images."""
FEW_PIXELS = 16
"""Warn if the images' longer side is shorter than this, pixels."""


def start(run: Run) -> Run:
    """Train and evaluate a new `run`, and return it with its settings and its folder.

    Raises:
        Stopped: if a signal ends it; the message names the saved checkpoint.
    """
    with joined_processes() as several:
        run = replace(run, folder=Path(from_first(str(run.folder))))  # its name contains the time
        trainer = _prepare(run)
        run = replace(run, config=trainer.config)  # with open settings filled in
        if not several.first:
            _follow(trainer)
            return run
        trainer.restore_as_configured()
        run = with_own_folder(run)
        trainer.folder = trainer.held_out.folder = run.folder
        with sole_user(run.folder):
            create_folder(run)
            _finish(run, trainer)
        return run


def resume(run: Run) -> None:
    """Continue a `run` from its newest checkpoint, or from the start if it has none.

    Raises:
        Stopped: if a signal ends it; the message names the saved checkpoint.
    """
    with joined_processes() as several, sole_user(run.folder) if several.first else nullcontext():
        trainer = _prepare(run)
        if not several.first:
            _follow(trainer)
            return
        checkpoint = load_newest(run.folder / FOLDER, trainer.device)
        if checkpoint is None:
            trainer.restore_as_configured()
            say(f"{run.folder} has no checkpoint: starting from the beginning")
        else:
            trainer.restore(checkpoint)
            say(f"resuming {run.folder} at step {trainer.state.step:,}")
        _finish(run, trainer)


def _prepare(run: Run) -> Trainer:
    if "viewer" in run.config.vis:
        require("viewer", f"--vis {run.config.vis} needs")
    check_weights(run.config.lpips_weights)
    device = choose_device(run.config.machine)
    train_set, images = on_device(load_split(run, "train"), device)
    eval_set = _held_out(run, device, MAX_IMAGES) if processes().first else None
    source = run.config.data or ("the embedded scene" if train_set.scene.num_scenes == 1 else "random scenes")
    say(f"{run.method} on {source} ({run.dataparser}), on {device.type}, kernels: {kernels(device)}")
    if processes().count > 1:
        threads = torch.get_num_threads()
        say(f"{processes().count} processes with batches of their own; CPU threads of each: {threads}")
        if device.type == "cpu" and processes().local_count > 1:
            say("note: on one CPU, several processes learn more slowly than one (docs/benchmarks.md)")
    if images is not None:
        say(images)
    trainer = Trainer.of(run, train_set, eval_set)
    trainer.held_out.load_all = lambda: _held_out(run, device)
    for line in trainer.profile.lines():
        say(line)
    if train_set.scene.image_size < FEW_PIXELS:
        say(f"warning: images of {train_set.scene.image_size} pixels are too small to learn from; are they thumbnails?")
    return trainer


def _held_out(run: Run, device: torch.device, most: int | None = None) -> Dataset | None:
    """Return the held-out images for evaluations during training, at most `most`; None if there are none."""
    found = first_split(run, ("val", "test"), most)
    return None if found is None else found.to(device, with_pixels=False)


def _follow(trainer: Trainer) -> None:
    """Train together with the first process. Only the first process writes and evaluates."""
    stopped_by = _train(trainer).stopped_by
    if stopped_by is not None:
        raise Stopped(stopped_by)


def _train(trainer: Trainer, between_steps: BetweenSteps | None = None) -> Outcome:
    """Train. If another process ends after the first step, save, and say how to continue."""
    try:
        return trainer.train(between_steps)
    except LostProcessError as error:
        if trainer.state.step == 0:
            raise
        ending = "" if trainer.folder is None else f"; {_continue_with(trainer.folder)}"
        if processes().first:
            with handled((signal.SIGTERM,), lambda number, frame: None):  # torchrun sends it after a process has ended
                trainer.save()
        raise LostProcessError(f"step {trainer.state.step:,}: {error}{ending}") from error


def _finish(run: Run, trainer: Trainer) -> None:
    by_images = isinstance(trainer.model, StartsFromImages)
    say(f"{'' if by_images else f'{trainer.model.size():,} parameters; '}writing to {run.folder}")
    # Also for a resumed run, which may have been killed before writing it.
    write_transforms(run, trainer.train_set)
    profile = run.folder / "scene_profile.json"
    if trainer.first_step == 0 or not profile.exists():  # a resumed run has no open settings, and keeps its profile
        write_report(profile, trainer.profile.as_plain())
    with _noted_stop(lambda: _saved_note(run)), _viewer(run, trainer) as between_steps:
        outcome = _train(trainer, between_steps)
    state = trainer.state
    say(
        f"{outcome.reason}: step {state.step:,}, {state.seconds:.1f} s of training, "
        f"{state.rays / max(state.seconds, 1e-9) / 1e3:.1f}k rays/s, "
        f"{peak_memory(trainer.device) / 2**30:.2f} GiB at most"
        + (f", {counted(state.skipped, 'steps')} skipped as not finite" if state.skipped else "")
    )
    rungs = skip_report(trainer)
    for line in lines(rungs):
        say(line)
    if (tiles := trainer.source.contradicted) is not None:
        say(f"--robust: {float(tiles.share):.1%} of the images' tiles do not count, as other images contradict them")
    trainer.model.tables.release()
    if isinstance(trainer.model, HasGaussians):
        say(_count(trainer.model))
        trainer.model.tables.release()
    write_report(run.folder / "skip_report.json", as_plain(rungs))
    write_summary(run.folder / SUMMARY, trainer, outcome)
    say(f"checkpoint: {outcome.checkpoint}")
    if outcome.stopped_by is not None:
        raise Stopped(outcome.stopped_by, _continue_with(run.folder))
    command = f"ns-eval {shlex.quote(str(run.folder))}"
    with _noted_stop(lambda: f"stopped while evaluating; the trained run is saved: {command}"):
        _evaluate(run, trainer, outcome)
    for line in after_training(trainer.model.scene, run.folder):
        say(line)


def _count(model: HasGaussians) -> str:
    """Return a line with the number of Gaussians, and of the ones that are not finite and never drawn."""
    gaussians = model.gaussians()
    bad = len(gaussians) - int(gaussians.finite().sum())
    return counted(len(gaussians), "Gaussians") + (f", {bad:,} of them not finite and never drawn" if bad else "")


def _evaluate(run: Run, trainer: Trainer, outcome: Outcome) -> None:
    test_set = first_split(run, ("test", "val"))
    if test_set is None or run.config.max_eval_images == 0:
        return
    say(f"evaluating held-out images; the first ones are written to {run.folder / 'pictures'}")
    evaluation = evaluate(
        trainer.model,
        with_refined_poses(trainer.model, test_set.to(trainer.device, with_pixels=False)),
        max_images=run.config.max_eval_images,
        seconds=evaluation_seconds(run.config, trainer.state),
        pictures=run.folder / "pictures",
        max_pictures=MAX_PICTURES,
        lpips_weights=run.config.lpips_weights,
    )
    say(f"test: {evaluation.line()}")  # before files are written, which may fail on a full disk
    if evaluation.far_below is not None:
        say(f"  {evaluation.far_below}")
    if evaluation.pictures_note is None:
        say(f"pictures (photograph, render, error, depth, opacity): {run.folder / 'pictures'}")
    else:
        say(f"warning: {evaluation.pictures_note}")
    if evaluation.warning is not None:
        say(f"warning: {evaluation.warning}")
    write_evaluation(run.folder / "eval.json", run, outcome.checkpoint, evaluation, trainer.device)
    if any(output.of_training for output in trainer.model.outputs):
        folder, seen = run.folder / "pictures" / "training", with_refined_poses(trainer.model, trainer.train_set)
        evaluate(trainer.model, seen, max_images=MAX_TRAINING, pictures=folder, title="Training images")
        say(f"pictures of training images, with what only one image contains: {folder}")


def after_training(scene: Scene, folder: Path) -> list[str]:
    """Return lines with commands: look at the run in `folder`, film its `scene` along a fitting path, and judge it."""
    run = shlex.quote(str(folder))
    path = "spiral" if scene.warped else "interpolate" if scene.unbounded else "orbit"
    lines = ["next:"]
    if scene.num_scenes == 1:
        lines.append(f"  look at it in a browser:  ns-viewer {run}")
        lines.append(f"  make a video:             ns-render {path} {run} --output-path {default_video(path)}")
    if scene.num_scenes == 1 and not scene.warped:
        lines.append(f"  make a web page of it:    ns-export web {run} --output-dir exports")
    lines.append(f"  evaluate it again:        ns-eval {run}")
    return lines


def _viewer(run: Run, trainer: Trainer) -> AbstractContextManager[BetweenSteps | None]:
    """Open the viewer of a run in training, if configured."""
    if "viewer" not in trainer.config.vis:
        return nullcontext()
    from nerfloom.viewer.training_viewer import training_viewer

    return training_viewer(run, trainer)


@contextmanager
def _noted_stop(note: Callable[[], str]) -> Iterator[None]:
    """If a signal ends the `with` block, raise Stopped with a note."""
    try:
        yield
    except KeyboardInterrupt as stop:
        raise Stopped(signal_of(stop), note()) from None


def _saved_note(run: Run) -> str:
    """Return a line that names the checkpoint of an interrupted run."""
    saved = list_checkpoints(run.folder / FOLDER)
    if not saved:
        return "stopped at once: nothing was saved"
    return f"stopped at once: the last checkpoint is {saved[-1].name}; {_continue_with(run.folder)}"


def _continue_with(folder: Path) -> str:
    """Return the end of a message with the command that continues the run in `folder`."""
    return f"continue with: ns-train --resume {shlex.quote(str(folder))}"

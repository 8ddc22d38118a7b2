"""The trainer of every method: training steps, checkpoints, periodic evaluation and stopping criteria."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nerfloom.base.checked import checked
from nerfloom.base.config import TrainConfig
from nerfloom.base.console import say
from nerfloom.base.device import BEFORE_STEP, seed_step
from nerfloom.base.errors import CheckpointError, DivergenceError
from nerfloom.base.pace import Pace
from nerfloom.base.plain import to_plain
from nerfloom.base.processes import alone, from_first, processes
from nerfloom.base.signals import stop_signals
from nerfloom.data.dataset import Dataset
from nerfloom.data.sources import BatchSource, Request
from nerfloom.kernels.native import torch_on_one_thread
from nerfloom.method import Method
from nerfloom.model import KeepsPace, StartsFromImages
from nerfloom.registry import load_method
from nerfloom.scene.profile import SceneProfile
from nerfloom.training.batch_size import BatchSize
from nerfloom.training.budget import reason_to_stop, spent
from nerfloom.training.checkpoint import FOLDER, checkpoint_path, load_checkpoint, load_newest, save_checkpoint
from nerfloom.training.graphs import kind_of_step, make_graphs
from nerfloom.training.held_out import HeldOut
from nerfloom.training.optim import first_non_finite, make_optimizer
from nerfloom.training.outcome import Outcome
from nerfloom.training.preparation import decided, profile_of, show_images, skip_empty
from nerfloom.training.progress import ProgressBar, Rate, StepReport, TensorBoard
from nerfloom.training.run import Run
from nerfloom.training.scout import budget, scout
from nerfloom.training.state import State, agree
from nerfloom.training.step import StepResult, learn, schedule, train_step
from nerfloom.training.taught import batch_source
from nerfloom.training.trained import restore_model

STEPS_PER_LOG = 25
"""Steps between points of TensorBoard's curves, and between readings of errors from a device."""
MIN_REPORTED_SECONDS = 0.5
"""Report preparation that takes at least this long, seconds."""
MAX_BAD_STEPS = 10
"""Number of consecutive non-finite steps that stop a run."""
BetweenSteps = Callable[[StepReport, Sequence[int]], None]
"""Function of a step's report and of the signals received so far; the sequence grows while the function runs."""


class Trainer:
    """Trainer of a method on a data set.

    Each of several processes has a trainer. Only the first process evaluates and writes.

    Args:
        config: its settings; open ones are decided from the data.
        train_set: training images, on the device.
        eval_set: images of the periodic evaluation; None for no evaluation.
        folder: folder of checkpoints, learning curve and TensorBoard's files; None to write nothing.
        source: source of the batches; None for the one that suits the model and the settings.
    """

    def __init__(
        self,
        method: Method,
        config: TrainConfig,
        train_set: Dataset,
        eval_set: Dataset | None = None,
        folder: Path | None = None,
        source: BatchSource | None = None,
    ) -> None:
        self.method, self.folder = method, folder
        self.config: TrainConfig
        start = time.perf_counter()
        train_set, self.config, self.decisions = decided(method, config, train_set)
        self._deciding = time.perf_counter() - start  # counts as training
        self.train_set, self.eval_set, self.device = train_set, eval_set, train_set.device
        torch.manual_seed(self.config.machine.seed)
        self.model = method.build(self.config, train_set.scene).to(self.device)
        show_images(self.model, train_set, eval_set)
        self.optimizer = make_optimizer(self.model, self.config)
        self.source = batch_source(self.model, train_set, self.config) if source is None else source
        self.state = State()
        self.first_step = 0
        self.steps_per_read = 1 if self.device.type == "cpu" else STEPS_PER_LOG
        """Steps between readings of errors from the device; each reading waits for it."""
        self._unread: list[Tensor] = []
        self._rate = Rate()
        mode = self.config.machine.cuda_graphs
        self.graphs = make_graphs(mode, self.device, self._learnt, lambda taken: taken[1].loss.total)
        self.held_out = HeldOut(self.config, self.model, eval_set, folder)
        self.batch_size: BatchSize | None = None
        if self.model.batches == "pixels":
            self.batch_size = BatchSize(self.model.config, recorded=self.graphs is not None)
        self._bad_in_a_row, self._prepared = 0, False
        self._saved_step: int | None = None
        self._last_save = 0.0

    @classmethod
    def of(cls, run: Run, train_set: Dataset, eval_set: Dataset | None = None) -> Trainer:
        """Return the trainer of `run` on images `train_set` and `eval_set`; it writes into the run's folder."""
        return cls(load_method(run.method), run.config, train_set, eval_set, run.folder)

    # -- checkpoints ------------------------------------------------------------------------------------------

    @property
    def checkpoint_folder(self) -> Path | None:
        """Folder of the checkpoints; None if nothing is written."""
        return None if self.folder is None else self.folder / FOLDER

    def save(self) -> Path | None:
        """Write a checkpoint and return its path, if any. A run resumed from it has the same bits."""
        self._read_errors(self.state.step)
        self._last_save = self.state.seconds
        step, keep_all, folder = self.state.step, not self.config.save_only_latest_checkpoint, self.checkpoint_folder
        if folder is None:
            return None
        path = save_checkpoint(folder, step, self._content(), keep_all, self._saved_step, self.model.tables.release)
        self._saved_step = step
        return path

    def _content(self) -> dict[str, Any]:
        """Return the content of a checkpoint."""
        return {
            "method": self.method.name,
            "config": to_plain(self.config),
            "scene": vars(self.model.scene.to("cpu")),
            "transform": self.train_set.transform.tolist(),  # float64, which not every device has
            "scale": self.train_set.scale,
            "model": self.model.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "state": vars(self.state),
            "errors": self.source.state(),
        }

    def _join_first(self) -> None:
        """Continue from the state of the first process, which reads the checkpoint and starts from the images."""
        if processes().count > 1:
            content = from_first(self._content(), self.device)
            if not processes().first:
                self.restore(content)

    def restore(self, checkpoint: dict[str, Any]) -> None:
        """Continue from the content of a `checkpoint`.

        Raises:
            CheckpointError: if it is of another method, or its parameters have other sizes.
        """
        restore_model(self.model, checkpoint, self.method.name)
        try:
            rates = [group["initial_lr"] for group in self.optimizer.param_groups]
            self.optimizer.load_state_dict(checkpoint["optimizer"])
            for group, rate in zip(self.optimizer.param_groups, rates, strict=True):
                group["initial_lr"] = rate  # the configured rate overrides the checkpoint's
            self.state = checked(State, checkpoint["state"])
            self._unread.clear()
            if self.graphs is not None:
                self.graphs.forget()
            self.source.restore(checkpoint.get("errors"))
        except (LookupError, TypeError, ValueError, RuntimeError, AttributeError) as error:
            raise CheckpointError(f"the checkpoint's optimiser or state does not fit: {error}") from error
        self.first_step = self._saved_step = self.state.step
        self._last_save = self.state.seconds
        self.held_out.resume(self.state)

    def restore_as_configured(self) -> None:
        """Restore the checkpoint of --load-checkpoint or --load-dir, if given; raise CheckpointError on failure."""
        if self.config.load_checkpoint is not None:
            self.restore(load_checkpoint(self.config.load_checkpoint, self.device))
        elif self.config.load_dir is not None:
            checkpoint = load_newest(self.config.load_dir, self.device)
            if checkpoint is None:
                raise CheckpointError(f"--load-dir {self.config.load_dir}: there is no checkpoint")
            self.restore(checkpoint)

    # -- the run ----------------------------------------------------------------------------------------------

    def train(self, between_steps: BetweenSteps | None = None) -> Outcome:
        """Train until the budget is spent, the target is reached or a signal arrives; then save.

        Args:
            between_steps: called after every step, in this thread; its time does not count as training. It must not
                change the model.

        Raises:
            DivergenceError: after MAX_BAD_STEPS consecutive non-finite steps; earlier checkpoints remain.
            CheckpointError: if the last checkpoint cannot be written.
            LostProcessError: if another of several processes ends.
        """
        self.prepare()
        first = processes().first
        with (
            stop_signals() as received,
            closing(TensorBoard(self.folder if first and "tensorboard" in self.config.vis else None)) as board,
            ProgressBar(self.method.name) as bar,
        ):
            while (reason := reason_to_stop(self.config, self.state, stopped := agree(self.state, received))) is None:
                report = self.train_step()
                bar.show(report)
                if report.step % STEPS_PER_LOG == 0:
                    board.step(report, self.state, self.optimizer.param_groups)
                self.held_out.evaluate_if_due(
                    self.state, board
                )  # before saving, so that a resumed run does not repeat it
                ends = not stopped and reason_to_stop(self.config, self.state, stopped) is not None
                self.held_out.look_if_due(self.state, report, board, last=ends)
                if self._due_to_save():
                    self._try_to_save()
                if between_steps is not None:
                    between_steps(report, received)
            if first:
                self.held_out.write_curve(self.state)
                self.save()  # a first Ctrl-C does not interrupt it
        saved = None if self.checkpoint_folder is None else checkpoint_path(self.checkpoint_folder, self.state.step)
        return Outcome(reason, next(iter(stopped), None), saved)

    def steps(self) -> Iterator[StepReport]:
        """Take training steps until the budget is spent, and yield each report: for training within another task.

        Unlike `train`, it does not evaluate, save or handle signals. It raises the same errors as `train_step`.
        """
        self.prepare()
        while reason_to_stop(self.config, self.state, ()) is None:
            yield self.train_step()

    @property
    def progress(self) -> float:
        """Fraction of the budget spent, 0 to 1: of steps or seconds, whichever is larger."""
        return spent(self.config, self.state)

    @cached_property
    def profile(self) -> SceneProfile:
        """The scene's profile, with the settings chosen from it. Computed once, since it reads every image."""
        return profile_of(self.method.name, self.config, self.model, self.train_set, self.decisions)

    def prepare(self, start: bool = True) -> None:
        """Find contradicted tiles, mark empty space and initialise the model from the images, before the first step.

        This counts as training time, but not again in a resumed run.

        Args:
            start: whether the model may initialise itself from the images; False if the caller sets its parameters.
        """
        if self._prepared:
            return
        self._prepared = True
        self._join_first()
        begun, fresh = time.perf_counter(), self.state.step == 0
        tiles, config = self.source.contradicted, self.config
        counts = fresh  # a resumed run has counted its preparation, but no scout that is new
        if tiles is not None and config.robust == "scout":
            if not tiles.known:
                counts = True
                self._by_first(partial(scout, Trainer, self.train_set, tiles, config, **budget(config)))
            self.train_set = self.train_set.drawing(tiles.counted())
        self.train_set = skip_empty(config, self.model, self.train_set, fresh)
        self.source = self.source.drawing_from(self.train_set)
        if fresh and start and isinstance(self.model, StartsFromImages):
            seed_step(config.machine.seed, -1)  # independent of earlier draws
            self._by_first(partial(self.model.start, self.train_set))
        seconds = time.perf_counter() - begun + self._deciding
        if counts:
            self.state.seconds += seconds
        if seconds >= MIN_REPORTED_SECONDS:
            say(f"prepared in {seconds:.1f} s" + (", which count as training" if counts else ""))

    def _by_first(self, work: Callable[[], None]) -> None:
        """Do work in the first process; the others then take over its state."""
        if processes().first:
            with alone():
                work()
        self._join_first()

    def train_step(self) -> StepReport:
        """Draw a batch and take one training step, after `prepare`.

        Raises:
            DivergenceError: after MAX_BAD_STEPS consecutive non-finite steps.
        """
        self.prepare()
        with torch_on_one_thread(self.model.runs_on_kernels):
            return self._train_step()

    def _train_step(self) -> StepReport:
        state, start = self.state, time.perf_counter()
        if self.config.max_seconds is not None and processes().count == 1:  # several must take equal steps
            pace = Pace(state.step, state.seconds, self.config.max_seconds, self.steps_per_read)
            if isinstance(self.model, KeepsPace):
                self.model.keep_pace(pace)
            if self.batch_size is not None:
                self.batch_size.keep_pace(pace)
        request = self._request()
        batch, result = self._drawn_and_taken(request)
        self.source.learn(request, batch, result.loss.rgb)
        errors, weights = result.squared_errors, getattr(batch, "weights", None)
        mse = errors.mean() if weights is None else (errors.mean(-1) * weights).sum() / weights.sum().clamp(min=1e-6)
        finite = result.finite if isinstance(result.finite, Tensor) else torch.full_like(mse, result.finite)
        num_rays = len(batch) * getattr(batch, "rays_per_pixel", 1)  # about as many in each process
        per_ray = result.loss.num_samples / max(num_rays, 1)
        done = state.step + 1
        unread = per_ray if isinstance(per_ray, Tensor) else torch.full_like(mse, math.nan)
        self._unread.append(torch.stack([mse, finite.to(mse), unread]))
        early = unread is per_ray and done < self.steps_per_read and done & (done - 1) == 0  # 1, 2, 4, 8, 16
        if early or done % self.steps_per_read == 0:
            self._read_errors(done)
        seconds = time.perf_counter() - start
        rays = num_rays * processes().count
        state.account(rays, math.nan if isinstance(per_ray, Tensor) else per_ray, seconds)
        self._rate.count(rays, seconds, waited=not self._unread)
        return StepReport(
            step=state.step,
            seconds=state.seconds,
            progress=self.progress,
            terms={name: value.detach() for name, value in result.loss.terms.items()},
            psnr=self.state.train_psnr,
            rays_per_second=self._rate.per_second,
            held_out=state.newest_held_out(self.first_step),
        )

    def _drawn_and_taken(self, request: Request) -> tuple[Any, StepResult]:
        """Return a batch and the result of a step on it. The next step overwrites both."""
        model, source, optimizer = self.model, self.source, self.optimizer
        step, progress, seed, rank = self.state.step, self.progress, self.config.machine.seed, processes().rank
        if self.graphs is None:
            seed_step(seed, step, rank)
            return (batch := source.draw(request)), train_step(model, optimizer, batch, step, progress)
        seed_step(seed, step, BEFORE_STEP)  # for updates of the sampler; the captured part is seeded separately
        schedule(model, optimizer, step, progress)

        def taken() -> tuple[Any, StepResult]:
            return (batch := source.draw(request)), learn(model, optimizer, batch, step, progress).detached()

        kind = kind_of_step(model, source, step, (request.num_pixels, request.rays_per_pixel, request.points))
        if self.graphs.take(kind):  # known after the schedules, which may change sizes
            return self.graphs.run(kind, lambda: seed_step(seed, step, rank), taken)
        seed_step(seed, step, rank)
        return taken()

    def _learnt(self) -> list[Tensor]:
        """Return all tensors that a step changes permanently."""
        return [*self.model.parameters(), *self.model.buffers(), *self.optimizer.tensors()]

    def _request(self) -> Request:
        """Return the request for the next batch."""
        if self.batch_size is None:
            return Request(self.state.step, 0, progress=self.progress)
        points = self.train_set.sparse_depth is not None
        return self.batch_size.request(self.state, self.model.samples_per_step, self.progress, points)

    def _count_bad(self, step: int, finite: bool) -> None:
        """Count dropped steps; raise DivergenceError after too many in a row."""
        self._bad_in_a_row = 0 if finite else self._bad_in_a_row + 1
        self.state.skipped += not finite
        if self._bad_in_a_row >= MAX_BAD_STEPS:
            saved = f"; the last good checkpoint is in {self.checkpoint_folder}" if self.folder else ""
            culprit = first_non_finite(self.model, self.optimizer) or "the loss"
            raise DivergenceError(
                f"step {step}: {MAX_BAD_STEPS} steps in a row were not finite, first in {culprit}"
                f"{saved}. Lower --learning-rate, or check the data"
            )

    def _read_errors(self, done: int) -> None:
        """Read errors and finiteness of the last steps from the device, after `done` steps in total."""
        unread = torch.stack(self._unread).tolist() if self._unread else []
        self._unread.clear()
        self.model.read_counts()
        for step, (mse, finite, samples_per_ray) in enumerate(unread, done - len(unread) + 1):
            self.state.learn_samples_per_ray(samples_per_ray)
            if math.isfinite(mse):  # a NaN of a dropped step would stay in the mean
                self.state.train_mse += max(0.02, 1 / step) * (mse - self.state.train_mse)
            else:
                self.optimizer.zero_grad()  # so that the error names the loss
            self._count_bad(step - 1, bool(finite))

    # -- reports and checkpoints between steps ----------------------------------------------------------------

    def _due_to_save(self) -> bool:
        aged = self.state.seconds - self._last_save >= self.config.seconds_per_save
        if not processes().first or not (aged or self.state.step % self.config.steps_per_save == 0):
            return False
        self._read_errors(self.state.step)
        return not self._bad_in_a_row  # else the parameters may be damaged; keep older checkpoints

    def _try_to_save(self) -> None:
        """Save a checkpoint. On failure, for example with a full disk, warn, continue and try again later."""
        try:
            self.save()
        except CheckpointError as error:
            say(f"warning: {error}")

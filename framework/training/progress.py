"""Display of training: a progress bar, and curves and images for TensorBoard."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import torch
from rich.progress import BarColumn, Progress, TextColumn
from torch import Tensor

from nerfloom.base.console import SECONDS_BETWEEN_LINES, console, say, track
from nerfloom.base.meter import UNKNOWN, left_text, time_text

if TYPE_CHECKING:
    from nerfloom.training.state import State

SECONDS_BETWEEN_STATES = 0.1
"""Seconds between updates of the progress bar. It shows losses, and reading them waits for a GPU."""


@dataclass(frozen=True)
class StepReport:
    """Report of a training step."""

    step: int
    """Number of training steps done, including this one."""
    seconds: float
    """Seconds of training so far."""
    progress: float
    """Fraction of the budget spent, 0 to 1."""
    terms: dict[str, Tensor]
    """Loss terms () of the batch, by name, possibly on the device."""
    psnr: float
    """Smoothed PSNR of the batches, dB; on a GPU as of the last read step."""
    rays_per_second: float
    """Rays per second; on a GPU between the last two reads."""
    held_out: tuple[float, float] | None
    """PSNR of the newest evaluation of held-out images, dB, and the seconds of training since; None before this
    process's first evaluation."""

    @cached_property
    def losses(self) -> dict[str, float]:
        """Loss terms of the batch, by name, read from the device on first use."""
        values = torch.stack(list(self.terms.values())).tolist() if self.terms else []
        return dict(zip(self.terms, values, strict=True))

    def line(self) -> str:
        """Return the report as a line of text."""
        return (
            f"step {self.step:,}  loss {sum(self.losses.values()):.5f}  PSNR {self.psnr:.2f} dB  {self.held_out_text}  "
            f"{self.rays_per_second / 1e3:.1f}k rays/s"
        )

    @property
    def held_out_text(self) -> str:
        """The PSNR of held-out images and its age, as text; a dash before the first evaluation."""
        if self.held_out is None:
            return f"held out {UNKNOWN}"
        psnr, age = self.held_out
        return f"held out {psnr:.2f} dB ({time_text(age)} ago)"


def share_and_time(first: StepReport, last: StepReport) -> str:
    """Return the spent percentage of the budget and the training time left, as text.

    The time follows from two reports of this process, since an earlier process may have run on another machine.

    Args:
        first: report of the first training step of this process.
        last: report of the last training step.
    """
    spent = last.progress - first.progress
    left = (last.seconds - first.seconds) / spent * (1 - last.progress) if spent > 0 else None
    return f"{100 * last.progress:.0f} %, {left_text(left)}"


class ProgressBar:
    """A progress bar after a `title` on a terminal; elsewhere, a line every ten seconds."""

    def __init__(self, title: str) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(bar_width=16), TextColumn("{task.fields[state]}"))
        self._bar = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
        self._task = self._bar.add_task(title, total=1.0, state="")
        self._first: StepReport | None = None
        self._last_line = time.monotonic()
        self._last_state = 0.0

    def __enter__(self) -> ProgressBar:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def show(self, report: StepReport) -> None:
        """Show the `report` of the last training step, unless the display was updated a moment ago."""
        self._first = self._first or report
        now = time.monotonic()
        if console.is_terminal and now - self._last_state > SECONDS_BETWEEN_STATES:
            self._last_state = now
            state = f"{share_and_time(self._first, report)}  {report.line()}"
            self._bar.update(self._task, completed=report.progress, state=state)
        if not console.is_terminal and now - self._last_line > SECONDS_BETWEEN_LINES:
            self._last_line = now
            say(f"{report.seconds:5.0f} s  {share_and_time(self._first, report)}  {report.line()}")


def take_all(steps: Iterator[StepReport], title: str) -> None:
    """Take all `steps` of a training within another task, and show the spent share of its budget after a `title`."""
    for percent in track(range(100), title, total=100):
        for report in steps:
            if report.progress >= (percent + 1) / 100:
                break


class Rate:
    """Rays per second between waits for the device, since a step without a wait seems too short."""

    def __init__(self) -> None:
        self.per_second = 0.0
        self._rays, self._seconds = 0, 0.0

    def count(self, rays: int, seconds: float, waited: bool) -> None:
        """Count a step of `rays` that took `seconds` and may have `waited` for the device."""
        self._rays += rays
        self._seconds += seconds
        if waited or self.per_second == 0:
            self.per_second = self._rays / self._seconds
        if waited:
            self._rays, self._seconds = 0, 0.0


class TensorBoard:
    """A writer of curves and images for TensorBoard into `folder`; None to write nothing."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder

    @cached_property
    def _writer(self) -> Any:
        from torch.utils.tensorboard import SummaryWriter  # slow to import

        return SummaryWriter(str(self._folder))

    def scalars(self, values: dict[str, float], step: int) -> None:
        """Write `values` by name, for a training `step`."""
        if self._folder is not None:
            for name, value in values.items():
                self._writer.add_scalar(name, value, step)

    def step(self, report: StepReport, state: State, groups: Sequence[Mapping[str, Any]]) -> None:
        """Write the `report` of a training step, with the run's `state`, and learning rates of parameter `groups`."""
        values = {
            **{f"train/loss/{name}": value for name, value in report.losses.items()},
            "train/psnr": report.psnr,
            "train/rays_per_second": report.rays_per_second,
            "train/samples_per_ray": state.samples_per_ray,
            "train/skipped_steps": float(state.skipped),
        }
        rates = {f"learning_rate/{group.get('name', index)}": group["lr"] for index, group in enumerate(groups)}
        self.scalars(values | rates, report.step)

    def image(self, name: str, image: Tensor, step: int) -> None:
        """Write an `image` (H, W, 3) in [0, 1] with the tag `name`, after `step` training steps."""
        if self._folder is not None:
            self._writer.add_image(name, image.clamp(0, 1), step, dataformats="HWC")

    def close(self) -> None:
        """Close the event files."""
        if "_writer" in vars(self):
            self._writer.close()

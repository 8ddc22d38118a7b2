"""Time of a training step, in each compiled CPU kernel or each GPU kernel, and in the rest."""

from __future__ import annotations

import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from nerfloom.base.console import say
from nerfloom.base.device import choose_device, wait_for
from nerfloom.kernels import native
from nerfloom.registry import load_method
from nerfloom.training.datasets import load_split
from nerfloom.training.machine import kernels, machine
from nerfloom.training.run import Run, create_folder
from nerfloom.training.trainer import Trainer

MAX_PRINTED, MAX_NAME_LENGTH = 25, 90
"""Number of GPU kernels that are printed, and length of their names."""
MAX_STEPS, MIN_STEPS, MAX_SECONDS = 200, 8, 30.0
"""Number of steps in an average of times; fewer, but at least the second number, if they take longer than the third,
seconds."""


def measure(run: Run, steps: int, max_seconds: float) -> dict[str, Any]:
    """Train a method, measure up to `MAX_STEPS` further steps, and print a line for each kernel.

    Args:
        steps: training steps before the measurement; the occupancy grid finds empty space in them.
        max_seconds: time budget, seconds, for the method's choice of settings.

    Returns:
        Milliseconds per step, in total and by kernel, as plain data.
    """
    with tempfile.TemporaryDirectory() as folder:
        trainer = endless_trainer(run, max_seconds, Path(folder))
        for _ in range(steps):
            trainer.train_step()
        wait_for(trainer.device)
        native.spent, rays = {}, trainer.state.rays
        start, count = time.perf_counter(), 0
        while count < MIN_STEPS or (count < MAX_STEPS and time.perf_counter() - start < MAX_SECONDS):
            trainer.train_step()
            count += 1
        wait_for(trainer.device)
        step = (time.perf_counter() - start) / count * 1e3
        rays = (trainer.state.rays - rays) // count
        spent_in, native.spent = {name: seconds / count * 1e3 for name, seconds in native.spent.items()}, None
        rest = "Python and torch"
        if trainer.device.type == "cuda":
            spent_in, rest = gpu_kernels(trainer.train_step, MIN_STEPS), "the GPU waits"
        repeated = 0 if trainer.graphs is None else trainer.graphs.repeated
        used = kernels(trainer.device)
    spent_in[rest] = step - sum(spent_in.values())
    parts = dict(sorted(spent_in.items(), key=lambda item: -item[1]))
    for name, spent in list(parts.items())[:MAX_PRINTED]:
        say(f"{name:28s} {spent:6.2f} ms  {spent / step:6.1%}")
    say(f"{'a step':28s} {step:6.2f} ms  {rays:,} rays, {used}, {repeated} steps repeated as CUDA graphs")
    return {
        "machine": machine(trainer.device),
        "kernels": used,
        "steps": count,
        "steps repeated as CUDA graphs": repeated,
        "rays per step": rays,
        "ms per step": round(step, 2),
        "ms": {name: round(spent, 3) for name, spent in parts.items()},
    }


def gpu_kernels(train_step: Callable[[], object], steps: int) -> dict[str, float]:
    """Return milliseconds per step in each GPU kernel, by name, including copies.

    Args:
        train_step: runs a training step.
        steps: number of steps to average over. They run apart from the steps that are timed, since recording kernels
            slows them.
    """
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as recorded:
        for _ in range(steps):
            train_step()
        torch.cuda.synchronize()
    spent = Counter[str]()
    for event in recorded.events():
        if event.device_type.name == "CUDA":
            spent[event.name[:MAX_NAME_LENGTH]] += event.self_device_time_total / 1e3 / steps
    return dict(spent)


def endless_trainer(run: Run, seconds: float, folder: Path) -> Trainer:
    """Return a trainer with the settings for a time budget, but without the budget itself.

    With a budget, the learning rate would fall over time, and a run that reaches its end would not be typical.

    Args:
        run: the run to train; its own budget and folder are not used.
        seconds: time budget, seconds, for the method's choice of settings.
        folder: parent of the run's folder.
    """
    config = replace(run.config, vis="none", max_seconds=seconds)
    run = replace(run, config=config, folder=folder / "run")
    train_set = load_split(run, "train").to(choose_device(run.config.machine))
    config, _ = load_method(run.method).decided(config, train_set.scene)
    run = replace(run, config=replace(config, max_seconds=None))
    create_folder(run)
    trainer = Trainer.of(run, train_set)
    trainer.prepare()
    return trainer

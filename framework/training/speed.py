"""Measurement of this machine's speed, before a run decides on its sizes."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TypeVar

import torch

from nerfloom.base.config import TrainConfig
from nerfloom.base.decisions import Decision
from nerfloom.base.device import device_kind, relative_speed
from nerfloom.base.processes import processes
from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.fields.encoded import EncodedField
from nerfloom.geometry.points import Points

ConfigT = TypeVar("ConfigT", bound=TrainConfig)
SAMPLES = 2**14
"""Number of samples in the timed step."""
REFERENCE_SECONDS = 11.6e-3
"""Seconds of this step on the machine that settings were tuned on: two idle cores of an AMD EPYC (Zen 4) with
AVX-512."""
MEASURING_SECONDS = 0.25
"""Duration of the measurement, seconds."""
MIN_BUDGET = 10.0
"""Minimum seconds of training for a measurement."""
SPEED_TOLERANCE = 1.4
"""Ignore a measured speed within this factor of the expected one, so that equal runs decide alike."""


def with_speed(config: ConfigT) -> tuple[ConfigT, list[Decision]]:
    """Return settings with the speed of this machine.

    It is measured if settings depend on it: in one process, on a CPU, with a budget of at least `MIN_BUDGET` seconds.

    Args:
        config: a method's settings; a configured speed stays.

    Returns:
        The settings, and a decision if the speed differs from the expected one.
    """
    machine = config.machine
    fixed = (config.max_seconds or 0.0) < MIN_BUDGET or machine.speed is not None or processes().count > 1
    if fixed or device_kind(machine) != "cpu":
        return config, []
    usual, found = relative_speed(machine), REFERENCE_SECONDS / step_seconds()
    if usual / SPEED_TOLERANCE < found < usual * SPEED_TOLERANCE:
        return config, []
    found = float(f"{found:.2g}")
    return replace(config, machine=replace(machine, speed=found)), [
        Decision("speed of this machine", f"{found:g} of the usual", "measured (else: --machine.speed)")
    ]


def step_seconds() -> float:
    """Return the mean seconds of a small training step of a hash grid and two networks, after a warm-up step."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        grid = HashGrid(max_resolution=256, log2_table_size=16, sparse=True)
        field = EncodedField(torch.tensor([[0.0] * 3, [1.0] * 3]), grid, 64, direction_levels=4)
        points = Points(torch.rand(SAMPLES, 3))
        directions = torch.nn.functional.normalize(torch.randn(SAMPLES, 3), dim=-1)
    steps, start = -1, time.perf_counter()
    while steps < 1 or time.perf_counter() - start < MEASURING_SECONDS:
        density, features = field.density(points)
        colors = field.color(features, directions)
        (density.mean() + colors.mean()).backward()
        field.zero_grad()
        if grid.deferred is not None:
            grid.deferred.clear()
        steps += 1
        if steps == 0:
            start = time.perf_counter()
    return (time.perf_counter() - start) / steps

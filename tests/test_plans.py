"""Settings that follow from the time, the images and the machine."""

import dataclasses
import itertools
import math

import pytest
import torch

from nerfloom.base.device import relative_speed
from nerfloom.base.machine_config import MachineConfig
from nerfloom.base.processes import Processes
from nerfloom.data.scene import Scene
from nerfloom.methods.instant_ngp import Plan, plan
from nerfloom.registry import load_method
from nerfloom.samplers.choice import batch_choice, samples_choices

SECONDS = [10 * 360 ** (step / 60) for step in range(61)]  # 10 s to 1 h
SIZES = (200, 400, 500, 800, 1600)
GROW = ("log2_table_size", "num_steps", "samples", "detail", "eval_step_scale")
"""Settings that grow with the time; the others fall."""
SPEEDS = [1 / (0.25 + 1.5 / threads) for threads in (1, 2, 3, 4, 8, 16)]


@pytest.mark.parametrize(
    ("seconds", "size", "found"),
    [
        (15, 400, Plan(16, 384, 24 * 2**10, 1, 0.02, 0.9, 1.0, 0.5)),
        (45, 400, Plan(17, 512, 25 * 2**10, 1, 0.01, 0.9, 0.5, 1.0)),
        (150, 400, Plan(18, 704, 45 * 2**10, 2, 0.01, 0.75, 0.5, 1.0)),
        (300, 400, Plan(18, 1024, 2**16, 2, 0.01, 0.75, 0.5, 1.0)),
        (math.inf, 400, Plan(18, 1024, 2**16, 2, 0.01, 0.75, 0.5, 1.0)),
        (300, 800, Plan(18, 1024, 2**16, 2, 0.01, 0.75, 0.5, 1.0)),
    ],
)
def test_where_trials_were_made_their_settings_are_taken(seconds: float, size: int, found: Plan) -> None:
    assert plan(seconds, size) == found


def test_settings_stay_within_what_was_tried_on_a_processor() -> None:
    for seconds, size, speed in itertools.product([*SECONDS, math.inf], SIZES, SPEEDS):
        found = plan(seconds, size, speed)
        assert 16 <= found.log2_table_size <= (18 if size <= 400 else 19)
        assert 384 <= found.num_steps <= 1024
        assert 24 * 2**10 <= found.samples <= 2**16
        assert found.detail in (1, 2)
        assert 0.01 <= found.learning_rate <= 0.02
        assert 0.75 <= found.several_rays_from <= 0.9
        assert 0.5 <= found.thin <= 1.0
        assert 0.5 <= found.eval_step_scale <= 1.0


@pytest.mark.parametrize("size", SIZES)
def test_more_time_moves_a_setting_one_way_and_not_more_than_as_many_times(size: int) -> None:
    for before, after in itertools.pairwise(SECONDS):
        less, more = plan(before, size), plan(after, size)
        for name, value in vars(less).items():
            smaller, larger = (value, getattr(more, name)) if name in GROW else (getattr(more, name), value)
            assert smaller <= larger, (before, after, name)
        # Sizes of tables and cells per pixel have whole steps; other numbers follow the time, except for rounding.
        assert more.num_steps <= less.num_steps * after / before + 32
        assert more.samples <= less.samples * after / before + 1024
        assert more.log2_table_size <= less.log2_table_size + 1


@pytest.mark.parametrize("seconds", [10, 45, 100, 150, 200, 300, 600, 3600])
def test_larger_images_get_larger_tables_and_wait_for_small_cells(seconds: float) -> None:
    for small, large in itertools.pairwise(plan(seconds, size) for size in SIZES):
        assert large.log2_table_size >= small.log2_table_size
        assert large.detail <= small.detail
        assert (large.num_steps, large.samples) == (small.num_steps, small.samples)


@pytest.mark.parametrize("speed", SPEEDS)
def test_a_faster_machine_decides_as_a_slower_one_with_more_time(speed: float) -> None:
    for seconds, size in itertools.product(SECONDS, SIZES):
        assert plan(seconds, size, speed) == plan(seconds * speed, size)


def test_speed_grows_with_threads_but_less_than_they_do(monkeypatch: pytest.MonkeyPatch) -> None:
    speeds = []
    for threads in range(1, 17):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        speeds.append(relative_speed(MachineConfig(device_type="cpu")))
    assert speeds[1] == 1
    assert 0.55 <= speeds[0] <= 0.58  # as measured
    for threads, (less, more) in enumerate(itertools.pairwise(speeds), 1):
        assert less < more < less * (threads + 1) / threads
    assert relative_speed(MachineConfig(device_type="cuda")) == 10
    monkeypatch.setattr("nerfloom.base.device.processes", lambda: dataclasses.replace(Processes(), count=2))
    assert relative_speed(MachineConfig(device_type="cpu")) == 1


@pytest.mark.parametrize(
    ("seconds", "device", "proposals", "count"),
    [
        (45.0, "cpu", (32, 16), 12),
        (100.0, "cpu", (32, 16), 12),
        (300.0, "cpu", (48, 24), 16),
        (600.0, "cpu", (80, 40), 24),
        (3600.0, "cpu", (112, 56), 32),
        (1e9, "cpu", (112, 56), 32),
        (None, "cpu", (128, 64), 32),
        (45.0, "cuda", (128, 64), 32),
    ],
)
def test_samples_a_ray_grow_with_the_time(
    seconds: float | None, device: str, proposals: tuple[int, ...], count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    machine = MachineConfig(device_type=device)  # type: ignore[arg-type]
    config = dataclasses.replace(load_method("nerfacto").config, max_seconds=seconds, machine=machine)
    first, second = samples_choices(config)
    assert (first.setting, first.value) == ("num_proposal_samples", proposals)
    assert (second.setting, second.value) == ("num_nerf_samples", count)


def test_samples_a_ray_never_fall_with_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    config = load_method("nerfacto").config
    for threads in (1, 2, 16):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        machine = MachineConfig(device_type="cpu")
        found = [
            samples_choices(dataclasses.replace(config, max_seconds=seconds, machine=machine))[1].value
            for seconds in (1.0, *SECONDS, 1e6)
        ]
        assert found == sorted(found)
        assert (found[0], found[-1]) == (12, 32)


@pytest.mark.parametrize(
    ("method", "seconds", "threads", "device", "samples"),
    [
        ("tensorf", 45.0, 2, "cpu", 2**13),
        ("tensorf", 150.0, 2, "cpu", 2**13),
        ("tensorf", 300.0, 2, "cpu", 2**14),
        ("tensorf", 600.0, 2, "cpu", 2**15),
        ("tensorf", 600.0, 1, "cpu", 18 * 1024),  # worth 343 s on two threads
        ("tensorf", 45.0, 2, "cuda", 2**15),
        ("tensorf", None, 2, "cpu", 2**15),
        ("kplanes", 45.0, 2, "cpu", 2**14),
        ("kplanes", 150.0, 2, "cpu", 2**15),
        ("kplanes", 600.0, 2, "cpu", 2**15),
    ],
)
def test_samples_a_step_follow_the_time(
    method: str, seconds: float | None, threads: int, device: str, samples: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    monkeypatch.setattr("nerfloom.samplers.choice.device_kind", lambda machine: machine.device_type)
    declared = load_method(method)
    machine = MachineConfig(device_type=device)  # type: ignore[arg-type]
    config = dataclasses.replace(declared.config, max_seconds=seconds, machine=machine)
    scene = Scene(torch.tensor([[-1.0] * 3, [1.0] * 3]), 0.1, 4.0, 1, True, False, 400)
    found, made = declared.decide(config, scene)
    assert found.samples_per_batch == samples
    assert [decision.choice for decision in made if decision.option == "samples a step"] == [str(samples)]
    chosen, made = declared.decide(dataclasses.replace(config, samples_per_batch=5000), scene)
    assert chosen.samples_per_batch == 5000
    assert "samples a step" not in [decision.option for decision in made]
    unbounded, _ = declared.decide(config, dataclasses.replace(scene, unbounded=True))
    assert (unbounded.sampler, unbounded.samples_per_batch) == ("proposal", 2**15)


def test_samples_a_step_never_fall_with_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    config = dataclasses.replace(load_method("tensorf").config, sampler="occupancy")
    for threads in (1, 2, 16):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        machine = MachineConfig(device_type="cpu")
        timed = [dataclasses.replace(config, max_seconds=seconds, machine=machine) for seconds in (1.0, *SECONDS, 1e6)]
        found = [batch_choice(config, 2**13, 2**15, 150.0).value for config in timed]
        assert found == sorted(found)
        assert (found[0], found[-1]) == (2**13, 2**15)

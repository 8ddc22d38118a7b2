"""ns-bench gpu: the parts that can be tested without a GPU."""

import copy
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
import torch

from nerfloom.benchmarks.ceilings import Ceilings
from nerfloom.benchmarks.gpu import (
    METHODS,
    Part,
    along_rays,
    gpu_plan,
    in_time,
    measured_kernels,
    psnr_at,
    reached,
    timed_steps,
)
from nerfloom.benchmarks.kernels import on_any_device
from nerfloom.cli.bench import main
from nerfloom.comparison.measures import Row
from tests.conftest import Refused


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_it_is_refused_in_a_line(refused: Refused, tmp_path: Path) -> None:
    assert "this machine or this PyTorch has no GPU" in refused(main, "gpu", "--output-dir", tmp_path)
    assert not list(tmp_path.iterdir())


def test_kernels_of_rays_are_right() -> None:
    names = set()
    for kernel in along_rays(256):
        assert kernel.errors is not None
        for found in kernel.errors():
            assert found.value < 1e-4
            assert found.gradient is None or found.gradient < 1e-4
        assert min(kernel.runs[0]()) > 0
        names.add((kernel.name, kernel.count))
    assert ("contraction", 256) in names
    assert ("weights of 64 intervals", 4) in names


def test_steps_are_timed_as_they_are_and_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    """The CPU has no graphs, so they are the same steps."""
    monkeypatch.setattr("nerfloom.benchmarks.gpu.SIZE", 16)
    small = {"num_rays_per_batch": 16, "log2_table_size": 8, "num_levels": 2}
    rows = timed_steps(torch.device("cpu"), 1, 2, **small)
    assert [row["method"] for row in rows] == ["nerfacto", "nerfacto", "instant-ngp", "instant-ngp"]
    for off, auto in (rows[:2], rows[2:]):
        assert [off["CUDA graphs"], auto["CUDA graphs"]] == ["off", "auto"]
        assert off["PSNR of batches, dB"] == auto["PSNR of batches, dB"]
        assert off["repeated"] == auto["repeated"] == 0
        assert min(off["ms a step"], auto["ms a step"]) > 0


def test_parts_for_which_too_little_time_is_left_are_left_out_and_named(capsys: pytest.CaptureFixture[str]) -> None:
    """The first part takes 30 of 100 s; the second would need 80, and the third has the 70 that it needs."""
    now, given, kept = [0.0], dict[str, float](), list[dict[str, Any]]()

    def part(name: str, least: float, takes: float) -> Part:
        def measure(left: float) -> dict[str, Any]:
            given[name] = left
            now[0] += takes
            return {name: takes}

        return Part(name, least, measure)

    parts = [part("kernels", 0, 30), part("training", 80, 80), part("graphs", 70, 5), part("more", 66, 1)]
    in_time(parts, 100.0, lambda found: kept.append(copy.deepcopy(found)), lambda: now[0])
    assert given == {"kernels": 100.0, "graphs": 70.0}
    assert kept[0] == {"kernels": 30, "left out, too little time": []}
    assert kept[-1] == {"kernels": 30, "graphs": 5, "left out, too little time": ["training", "more"]}
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(";")[0] for line in lines if ";" in line] == ["left out: training", "left out: more"]


def test_kernels_are_not_timed_after_their_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are made even so, for their names. The large ones: test_every_kernel_is_measured_and_right."""
    monkeypatch.setattr("nerfloom.benchmarks.gpu.triton_backend.available", lambda: False)
    monkeypatch.setattr("nerfloom.benchmarks.gpu.on_any_device", lambda samples: islice(on_any_device(samples), 1))
    monkeypatch.setattr(Ceilings, "measured", lambda *sizes: Ceilings(1.0, 1.0, 1.0))  # some take half a minute
    found = measured_kernels(torch.device("cpu"), 64, 1, -1.0)
    assert found["kernels"] == []
    assert found["kernels not timed"][0].startswith("hash grid")
    assert "contraction" in found["kernels not timed"]


def test_the_psnr_after_some_seconds_is_that_of_the_last_evaluation_until_then() -> None:
    curve = ((1.9, 20.0), (4.0, 25.0), (60.0, 30.0))
    assert [psnr_at(curve, seconds) for seconds in (1, 2, 5, 15, 60)] == [None, 20.0, 25.0, 25.0, 30.0]


def test_methods_are_trained_on_the_gpu_and_failures_are_told(tmp_path: Path) -> None:
    plan = gpu_plan(None, 60.0, tmp_path)
    assert tuple(contender.method for contender in plan.contenders) == METHODS
    assert plan.conditions.device_type == "cuda"
    assert reached([Row("instant-ngp", (), ("out of memory",))]) == [
        {"method": "instant-ngp", "failures": ["out of memory"]}
    ]

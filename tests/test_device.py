"""Devices and random streams."""

import pytest
import torch

from nerfloom.base.device import choose_device, has_bfloat16, peak_memory, stream_seed
from nerfloom.base.errors import ConfigError
from nerfloom.base.machine_config import MAX_THREADS, MachineConfig


def test_every_step_has_a_stream_of_its_own() -> None:
    seeds = {stream_seed(seed, step) for seed in range(40) for step in range(500)}
    assert len(seeds) == 40 * 500
    assert all(0 <= seed < 2**63 for seed in seeds)
    share = sum(bin(seed).count("1") for seed in seeds) / (63 * len(seeds))
    assert share == pytest.approx(0.5, abs=0.005)


def test_a_device_that_is_not_there_is_refused() -> None:
    if torch.cuda.is_available():
        pytest.skip("this machine has CUDA")
    with pytest.raises(ConfigError, match=r"--machine\.device-type cuda"):
        choose_device(MachineConfig(device_type="cuda"))
    assert choose_device(MachineConfig()).type == "cpu"


def test_threads_are_set_and_checked() -> None:
    before = torch.get_num_threads()
    try:
        choose_device(MachineConfig(device_type="cpu", num_threads=1))
        assert torch.get_num_threads() == 1
    finally:
        torch.set_num_threads(before)
    for number in (0, MAX_THREADS + 1):
        with pytest.raises(ConfigError, match=rf"--machine\.num-threads is {number}; it must be from 1 to "):
            choose_device(MachineConfig(num_threads=number))
    assert torch.get_num_threads() == before


def test_peak_memory_counts_what_is_held() -> None:
    block = torch.ones(2**26)  # 256 MiB
    assert peak_memory(torch.device("cpu")) > block.numel() * 4
    assert isinstance(has_bfloat16(torch.device("cpu")), bool)

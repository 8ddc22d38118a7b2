"""The same seed and thread count give the same bits in another process, of every method."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from nerfloom.base.machine_config import MachineConfig
from tests.patience import PATIENCE
from tests.training.helpers import TINY, differences, tiny_trainer

ROOT = Path(__file__).parents[2]
TRAIN = """
import sys
from pathlib import Path
import torch
from tests.training.helpers import TINY, tiny_trainer

torch.set_num_threads(int(sys.argv[3]))
for kind in TINY:
    tiny_trainer(kind, Path(sys.argv[1]), Path(sys.argv[2]) / kind, max_num_iterations=30).train()
"""
CIRCUMSTANCES = (
    {"PYTHONHASHSEED": "1"},
    {"PYTHONHASHSEED": "2", "MALLOC_PERTURB_": "165"},  # memory that nobody has written to is filled with this
)


def test_every_method_is_asked() -> None:
    methods = {file.stem.replace("_", "-") for file in (ROOT / "methods").glob("[!_]*.py")}
    assert {kind.split("+")[0] for kind in TINY} == methods


def test_another_seed_leaves_another_checkpoint(shared_tiny: Path, tmp_path: Path) -> None:
    """Or the comparison compares nothing."""
    for name, seed in (("first", 1), ("again", 1), ("other", 2)):
        machine = MachineConfig(seed=seed)
        tiny_trainer("instant-ngp", shared_tiny, tmp_path / name, max_num_iterations=3, machine=machine).train()
    assert differences(tmp_path / "first", tmp_path / "again") == []
    found = differences(tmp_path / "first", tmp_path / "other")
    assert {"/model/field.encoding.table", "/state/train_mse"} <= set(found)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("threads", "kernels"),
    [(1, "auto"), (2, "auto"), (1, "reference")],  # on several threads torch alone adds in any order
)
def test_two_processes_leave_the_same_checkpoints(
    threads: int, kernels: str, shared_tiny: Path, tmp_path: Path
) -> None:
    """Python's order of hashed values, and the earlier content of memory, have no effect."""
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", TRAIN, str(shared_tiny), str(tmp_path / str(index)), str(threads)],
            env={**os.environ, "PYTHONPATH": str(ROOT), "NERFLOOM_KERNELS": kernels, **circumstances},
            stderr=subprocess.PIPE,
            text=True,
        )
        for index, circumstances in enumerate(CIRCUMSTANCES)
    ]
    said = [process.communicate(timeout=PATIENCE)[1] for process in processes]
    assert [process.returncode for process in processes] == [0, 0], said
    for kind in TINY:
        assert differences(tmp_path / "0" / kind, tmp_path / "1" / kind) == [], kind

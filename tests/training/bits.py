"""Hashes of what small runs of every method come to, as JSON: python -m tests.training.bits DATA FOLDER THREADS

For tests that compare processes (`tests/training/test_determinism.py`).
"""

import hashlib
import json
import sys
from pathlib import Path

import torch

from tests.training.helpers import TINY, tensors, tiny_trainer

STEPS = 12
"""The occupancy grid is updated at the eighth, and by then a difference in one bit is everywhere."""


def hashes(data: Path, folder: Path) -> dict[str, str]:
    """Of parameters, buffers and the optimiser's state of each small method after some steps on `data`."""
    found = {}
    for kind in TINY:
        trainer = tiny_trainer(kind, data, folder / kind)
        for _ in range(STEPS):
            trainer.train_step()
        digest = hashlib.sha256()
        for name, value in sorted(tensors(trainer).items()):
            digest.update(name.encode() + value.contiguous().numpy().tobytes())
        found[kind] = digest.hexdigest()
    return found


if __name__ == "__main__":
    torch.set_num_threads(int(sys.argv[3]))
    print(json.dumps(hashes(Path(sys.argv[1]), Path(sys.argv[2]))))

"""Where the time of a training step goes.

    python benchmarks/profile_step.py --data DIR [--method instant-ngp] [--steps 900] [--max-seconds 45]

trains so many steps, then measures 200 more: each compiled kernel's share, and what is left for Python and torch.
Writes benchmarks/results/profile-METHOD.json.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import tempfile
import time
from pathlib import Path

from framework.base.registry import load_dataparser, load_method
from framework.cli.session import load_split
from framework.data.data_folder import find_data
from framework.kernels import native
from framework.training.run import Run, create_folder
from framework.training.trainer import Trainer

MEASURED = 200


def main() -> None:
    """Train, measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--method", default="instant-ngp")
    parser.add_argument("--steps", type=int, default=900)
    parser.add_argument("--max-seconds", type=float, default=45)
    flags = parser.parse_args()
    config = load_method(flags.method).config
    # The schedule must not end while it is measured: the settings for the time are taken, the time itself is not.
    config = dataclasses.replace(config, data=flags.data, vis="none", max_seconds=flags.max_seconds).resolved()
    config = dataclasses.replace(config, max_seconds=None)
    folder_of_data, name = find_data(flags.data)
    config = dataclasses.replace(config, data=folder_of_data)
    with tempfile.TemporaryDirectory() as folder:
        run = Run(flags.method, config, name, load_dataparser(name)(), Path(folder) / "run")
        create_folder(run)
        trainer = Trainer(run, load_split(run, "train"), None)
        for _ in range(flags.steps):
            trainer.train_step()
        native.spent = {}
        start = time.perf_counter()
        for _ in range(MEASURED):
            trainer.train_step()
        step = (time.perf_counter() - start) / MEASURED * 1e3
    kernels = {name: seconds / MEASURED * 1e3 for name, seconds in native.spent.items()}
    kernels["Python and torch"] = step - sum(kernels.values())
    shares = dict(sorted(kernels.items(), key=lambda item: -item[1]))
    for name, spent in shares.items():
        print(f"{name:28s} {spent:6.2f} ms  {spent / step:6.1%}")
    print(f"{'a step':28s} {step:6.2f} ms  {native.variant()}")
    content = {
        "kernels": native.variant(),
        "ms per step": round(step, 2),
        "ms": {n: round(v, 3) for n, v in shares.items()},
    }
    path = Path(__file__).parent / "results" / f"profile-{flags.method}.json"
    path.write_text(json.dumps(content, indent=2) + "\n")


if __name__ == "__main__":
    main()

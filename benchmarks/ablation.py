"""What each part of instant-ngp is worth: trained with one of them off, or on, in turn.

    python benchmarks/ablation.py --data DIR [--seconds 45] [--seeds 2] [--target 30]

Every variant is trained with every seed, the variants in turn so that a machine whose speed drifts treats them alike.
Reports seconds of training to the target PSNR on validation views and the final PSNR on all test views, means over
seeds with the standard deviation of a single run, and writes benchmarks/results/ablation-DATA.json.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
from itertools import pairwise
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from framework.base.child import python_command
from framework.kernels import native

VARIANTS: dict[str, list[str]] = {
    "as it is": [],
    "no visual hull (cells and pixels)": ["--silhouette-cells", "False"],
    "pixels that see background alone are drawn": ["--silhouette-pixels", "False"],
    "pixels drawn by error": ["--draw-by-error", "True"],
    "hidden samples evaluated": ["--train-early-stop", "0"],
    "early stop in training at 1e-4": ["--train-early-stop", "1e-4"],
    "sparse updates of the tables": ["--sparse-updates", "True"],
    "dense updates of the tables": ["--sparse-updates", "False"],
    "finest level not by the images' size, but 2048": ["--max-resolution", "2048"],
    "no view dependence": ["--view-dependence", "False"],
    "one ray a pixel": ["--rays-per-pixel", "1"],
}
VIEWS = 4
"""Validation views of the learning curve."""


def main() -> None:
    """Train every variant, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--seconds", type=float, default=45)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--target", type=float, default=30)
    flags = parser.parse_args()
    runs: dict[str, list[tuple[float | None, float]]] = {name: [] for name in VARIANTS}
    for seed in range(flags.seeds):
        for name, switches in VARIANTS.items():
            runs[name].append(train(flags.data, flags.seconds, seed, flags.target, switches))
            print(f"seed {seed}  {name}: {runs[name][-1]}", flush=True)
    rows = [summary(name, found) for name, found in runs.items()]
    for row in rows:
        print(row)
    content = {
        "kernels": native.variant(),
        "seconds": flags.seconds,
        "seeds": flags.seeds,
        "target, dB": flags.target,
        "rows": rows,
    }
    path = Path(__file__).parent / "results" / f"ablation-{flags.data.name}.json"
    path.write_text(json.dumps(content, indent=2) + "\n")


def train(data: Path, seconds: float, seed: int, target: float, switches: list[str]) -> tuple[float | None, float]:
    """Seconds to the target, None where it was not met, and the final PSNR on the test views."""
    with tempfile.TemporaryDirectory() as folder:
        command = python_command("framework.cli.train", "instant-ngp", "--data", data)
        command += ["--max-seconds", str(seconds), "--machine.seed", str(seed), "--vis", "none"]
        command += ["--seconds-per-eval-all-images", str(seconds / 9), "--max-eval-images", str(VIEWS)]
        command += ["--output-dir", folder, *switches]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        config = next(Path(folder).rglob("config.yml"))
        points = [p for p in read(config.parent / "learning_curve.json") if p["full"]]
        curve = [(0.0, 0.0)] + [(p["seconds"], p["psnr"]) for p in points]
        command = python_command("framework.cli.evaluate", "--load-config", config)
        command += ["--output-path", str(Path(folder) / "all.json")]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        return crossing(curve, target), read(Path(folder) / "all.json")["results"]["psnr"]


def read(path: Path) -> Any:
    """JSON."""
    return json.loads(path.read_text())


def crossing(curve: list[tuple[float, float]], target: float) -> float | None:
    """When a curve of (seconds, PSNR) first meets the target, between its points by straight lines."""
    for (t0, p0), (t1, p1) in pairwise(curve):
        if p1 >= target > p0:
            return t0 + (t1 - t0) * (target - p0) / (p1 - p0)
    return None


def summary(name: str, found: list[tuple[float | None, float]]) -> dict[str, Any]:
    """Means over seeds."""
    times, psnrs = [t for t, _ in found if t is not None], [p for _, p in found]
    return {
        "variant": name,
        "seconds to the target": round(fmean(times), 1) if len(times) == len(found) else None,
        "test PSNR, dB": round(fmean(psnrs), 3),
        "standard deviation of a run, dB": round(stdev(psnrs), 3) if len(psnrs) > 1 else None,
    }


if __name__ == "__main__":
    main()

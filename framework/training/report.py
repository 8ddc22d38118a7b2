"""The evaluation's file, with nerfstudio's keys."""

from __future__ import annotations

from pathlib import Path

from framework.evaluation.evaluator import Evaluation
from framework.training.run import Run, write_json


def write_evaluation(path: Path, run: Run, checkpoint: Path, found: Evaluation) -> None:
    """`experiment_name, method_name, checkpoint, results`, and what was measured on each image."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(
        path,
        {
            "experiment_name": run.folder.parent.parent.name,
            "method_name": run.method,
            "checkpoint": checkpoint.name,
            "rays_per_pixel": run.config.resolved().rays_per_pixel,
            "eval_appearance": found.eval_appearance,
            "results": found.results,
            "lpips": found.lpips_note,
            "per_image": found.per_image,
        },
    )

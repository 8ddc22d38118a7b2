"""Reports of a run: its evaluation, with nerfstudio's keys, and a summary of its training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from nerfloom.base.device import peak_memory
from nerfloom.base.errors import ConfigError
from nerfloom.base.json_files import finite_or_null, write_json
from nerfloom.evaluation.evaluator import Evaluation
from nerfloom.training.machine import kernels, machine
from nerfloom.training.outcome import Outcome
from nerfloom.training.run import Run, write_report
from nerfloom.training.trainer import Trainer

SUMMARY = "summary.json"
"""Name of the summary in a run's folder."""


def write_evaluation(
    path: Path,
    run: Run,
    checkpoint: Path | None,
    found: Evaluation,
    device: torch.device,
    geometry: dict[str, Any] | None = None,
) -> None:
    """Write the metrics of an evaluation as JSON: nerfstudio's keys, the metrics of each image, and of the surface.

    Non-finite metrics and their means are null.

    Args:
        path: file to write; its folder is created if missing.
        run: the evaluated run.
        checkpoint: the evaluated checkpoint, for its name; None without a file.
        found: the metrics.
        device: device of the evaluation.
        geometry: metrics of the surface; None if it was not compared with a reference.

    Raises:
        ConfigError: if the file cannot be written.
    """
    content = {
        "experiment_name": run.folder.parent.parent.name,
        "method_name": run.method,
        "checkpoint": None if checkpoint is None else checkpoint.name,
        "kernels": kernels(device),
        "rays_per_pixel": getattr(run.config, "rays_per_pixel", 1),
        "eval_appearance": found.eval_appearance,
        "results": finite_or_null(found.results),
        "lpips": found.lpips_note,
        "masks": found.masks_note,
        "geometry": finite_or_null(geometry),
        "per_image": finite_or_null(found.per_image),
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, content)
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror or error}") from error


def write_summary(path: Path, trainer: Trainer, outcome: Outcome) -> None:
    """Write the steps, seconds and memory of `trainer`, its `outcome` and the machine to the JSON file `path`."""
    state = trainer.state
    write_report(
        path,
        {
            "method": trainer.method.name,
            "stopped": outcome.reason,
            "interrupted": outcome.interrupted,
            "steps": state.step,
            "seconds": state.seconds,
            "rays": state.rays,
            "rays_per_second": state.rays / max(state.seconds, 1e-9),
            # Mean of the last steps, without the samples of proposals; of an octree, leaves.
            **({"samples_per_ray": state.samples_per_ray} if trainer.model.batches == "pixels" else {}),
            "skipped_steps": state.skipped,
            "peak_memory_bytes": peak_memory(trainer.device),
            "parameters": trainer.model.size(),
            "machine": machine(trainer.device),
        },
    )

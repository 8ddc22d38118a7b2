"""What refining camera poses mends: the embedded scene with its training poses disturbed.

    python benchmarks/pose_refinement.py [--seconds 120] [--degrees 1] [--percent 1] [--method nerfacto]

Every training camera is turned by an angle about a random axis and moved by a share of its distance from the scene's
middle in a random direction. Three runs: exact poses; disturbed ones as they are; disturbed ones refined, by SO3xR3 and
by SE3. Reports the poses' errors before and after, once the best similarity between them and the true ones is taken
out, and the PSNR on test views, whose cameras are brought into the disturbed poses' frame by a similarity. Writes
benchmarks/results/pose-refinement.json.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dataparsers.procedural import Procedural
from framework.base.registry import load_method
from framework.cameras.cameras import Cameras
from framework.cameras.refinement import PoseRefinement
from framework.data.dataset import Dataset, load_dataset
from framework.evaluation.evaluator import evaluate
from framework.geometry.alignment import align_cameras, pose_errors
from framework.kernels.math import cross_matrix
from framework.training.run import Run, create_folder
from framework.training.trainer import Trainer


def main() -> None:
    """Train, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seconds", type=float, default=120)
    parser.add_argument("--degrees", type=float, default=1)
    parser.add_argument("--percent", type=float, default=1)
    parser.add_argument("--method", default="nerfacto")
    flags = parser.parse_args()
    exact, test = (load_dataset(Procedural().parse(None, split), split) for split in ("train", "test"))
    cameras = disturb(exact.cameras, flags.degrees, flags.percent / 100)
    scene = replace(exact.scene, camera_to_worlds=cameras.camera_to_worlds)
    disturbed = replace(exact, cameras=cameras, scene=scene)
    rows = [
        train(flags, name, data, exact, test, optimizer)
        for name, data, optimizer in (
            ("exact poses", exact, "off"),
            ("disturbed", disturbed, "off"),
            ("disturbed, refined by SO3xR3", disturbed, "SO3xR3"),
            ("disturbed, refined by SE3", disturbed, "SE3"),
        )
    ]
    content = {**{k: getattr(flags, k) for k in ("seconds", "degrees", "percent", "method")}, "rows": rows}
    path = Path(__file__).parent / "results" / "pose-refinement.json"
    path.write_text(json.dumps(content, indent=2) + "\n")


def disturb(cameras: Cameras, degrees: float, share: float) -> Cameras:
    """Cameras turned by `degrees` about random axes, and moved by a share of their distance from the origin."""
    draws = torch.Generator().manual_seed(0)
    count, angle = len(cameras), math.radians(degrees)
    axes, steps = (torch.nn.functional.normalize(torch.randn(count, 3, generator=draws), dim=-1) for _ in range(2))
    turns = torch.linalg.matrix_exp(cross_matrix(angle * axes))
    centres = cameras.camera_to_worlds[:, :, 3]
    moved = centres + share * centres.norm(dim=-1, keepdim=True) * steps
    turned = turns @ cameras.camera_to_worlds[:, :, :3]
    return replace(cameras, camera_to_worlds=torch.cat([turned, moved[:, :, None]], dim=-1))


def train(
    flags: Any, name: str, data: Dataset, exact: Dataset, test: Dataset, optimizer: str
) -> dict[str, float | str]:
    """One run's errors and PSNR."""
    with tempfile.TemporaryDirectory() as folder:
        config = replace(
            load_method(flags.method).config,
            max_seconds=flags.seconds,
            camera_optimizer=optimizer,
            vis="none",
        )
        run = Run(flags.method, config, "procedural", Procedural(), Path(folder) / "run")
        create_folder(run)
        trainer = Trainer(run, data, None)
        trainer.train()
    refinement = next((m for m in trainer.model.modules() if isinstance(m, PoseRefinement)), None)
    found = data.cameras if refinement is None else refinement.refined(data.cameras)
    truth = exact.cameras.camera_to_worlds
    before, after = pose_errors(data.cameras.camera_to_worlds, truth), pose_errors(found.camera_to_worlds, truth)
    carried = carry(test.cameras, truth, data.cameras.camera_to_worlds)  # from there the model carries them on
    row = {
        "run": name,
        "median angle before, degrees": round(before.median_angle, 4),
        "median angle after, degrees": round(after.median_angle, 4),
        "median centre error before, of the extent": round(before.median_distance, 6),
        "median centre error after, of the extent": round(after.median_distance, 6),
        "test PSNR, dB": round(evaluate(trainer.model, replace(test, cameras=carried)).results["psnr"], 2),
        "steps": trainer.state.step,
    }
    print(row, flush=True)
    return row


def carry(cameras: Cameras, truth: Tensor, found: Tensor) -> Cameras:
    """Cameras in the frame of the true poses as they stand in that of the poses found."""
    scale, rotation, translation = align_cameras(truth, found)
    poses = cameras.camera_to_worlds.double()
    centres = scale * (poses[:, :, 3] @ rotation.T) + translation
    moved = torch.cat([rotation @ poses[:, :, :3], centres[:, :, None]], dim=-1)
    return replace(cameras, camera_to_worlds=moved.float())


if __name__ == "__main__":
    main()

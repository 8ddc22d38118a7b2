"""Effect of refining camera poses, on the embedded scene with disturbed training poses.

Each training camera is rotated about a random axis, and moved in a random direction by a fraction of its distance from
the scene's centre. There are four runs: exact poses, disturbed poses without refinement, and disturbed poses refined by
SO3xR3 and by SE3. The results are the errors of the poses before and after, without the best similarity transform to
the true poses, and the PSNR of test views. The test cameras are transformed to the frame of the disturbed poses by a
similarity.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.pose_errors import pose_errors
from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError
from nerfloom.cameras.cameras import Cameras
from nerfloom.data.dataset import Dataset, load_dataset
from nerfloom.evaluation.evaluator import evaluate
from nerfloom.geometry.alignment import align_cameras
from nerfloom.kernels.math import cross_matrix
from nerfloom.methods._captures import ProposedConfig
from nerfloom.registry import load_dataparser, load_method
from nerfloom.renderable import refined_cameras, with_refined_poses
from nerfloom.training.machine import machine
from nerfloom.training.run import Run, create_folder
from nerfloom.training.trainer import Trainer

SCENE = "procedural"
"""Data format of the embedded scene."""


def measure(method: str, seconds: float, degrees: float, percent: float) -> dict[str, Any]:
    """Train a method on exact, disturbed and refined poses, and print a line for each run.

    Args:
        method: name of the method.
        seconds: seconds of training of each run.
        degrees: rotation of each camera, degrees.
        percent: shift of each camera, per cent of its distance from the origin.

    Returns:
        The machine, the arguments and a row for each run, as plain data.

    Raises:
        ConfigError: if the method cannot refine poses.
    """
    refinable(method)  # checked before the slow rendering of the scene
    embedded = load_dataparser(SCENE)()
    exact, test = (load_dataset(embedded.parse(None, split), split) for split in ("train", "test"))
    cameras = disturb(exact.cameras, degrees, percent / 100)
    scene = replace(exact.scene, camera_to_worlds=cameras.camera_to_worlds)
    disturbed = replace(exact, cameras=cameras, scene=scene)
    rows = []
    for name, data, optimizer in (
        ("exact poses", exact, "off"),
        ("disturbed", disturbed, "off"),
        ("disturbed, refined by SO3xR3", disturbed, "SO3xR3"),
        ("disturbed, refined by SE3", disturbed, "SE3"),
    ):
        trainer = trained(method, data, seconds, optimizer)
        rows.append({"run": name, **errors(trainer, data, exact, test)})
        say(str(rows[-1]))
    arguments = {"seconds": seconds, "degrees": degrees, "percent": percent, "method": method}
    return {"machine": machine(), **arguments, "rows": rows}


def disturb(cameras: Cameras, degrees: float, share: float) -> Cameras:
    """Rotate cameras about random axes, and move them in random directions.

    Args:
        cameras: N cameras.
        degrees: angle of each rotation, degrees.
        share: length of each displacement, as a fraction of the camera's distance from the origin.
    """
    generator = torch.Generator().manual_seed(0)
    count, angle = len(cameras), math.radians(degrees)
    axes, steps = (torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1) for _ in range(2))
    rotations = torch.linalg.matrix_exp(cross_matrix(angle * axes))
    centres = cameras.camera_to_worlds[:, :, 3]
    moved = centres + share * centres.norm(dim=-1, keepdim=True) * steps
    rotated = rotations @ cameras.camera_to_worlds[:, :, :3]
    return replace(cameras, camera_to_worlds=torch.cat([rotated, moved[:, :, None]], dim=-1))


def refinable(method: str) -> Any:
    """Return the settings of a `method` that refines poses; with proposals if it needs them: marches have no gradient.

    Raises:
        ConfigError: if the method cannot refine poses.
    """
    config = load_method(method).config
    if not hasattr(config, "camera_optimizer"):
        raise ConfigError(f"--method {method}: it cannot refine poses: it has no --camera-optimizer")
    return replace(config, sampler="proposal") if isinstance(config, ProposedConfig) else config


def trained(method: str, data: Dataset, seconds: float, camera_optimizer: str) -> Trainer:
    """Train a method on a data set in memory.

    Args:
        method: name of the method.
        data: training images with cameras.
        seconds: seconds of training.
        camera_optimizer: refinement of the poses, as in the flag of that name.

    Raises:
        ConfigError: if the method cannot refine poses.
    """
    config = replace(refinable(method), max_seconds=seconds, camera_optimizer=camera_optimizer, vis="none")
    with tempfile.TemporaryDirectory() as folder:
        run = Run(method, config, SCENE, load_dataparser(SCENE)(), Path(folder) / "run")
        create_folder(run)
        trainer = Trainer.of(run, data)
        trainer.train()
    return trainer


def errors(trainer: Trainer, data: Dataset, exact: Dataset, test: Dataset) -> dict[str, float]:
    """Return the errors of a run's poses, and its PSNR.

    Args:
        trainer: the trainer, after training.
        data: training images with the run's given poses.
        exact: training images with the true poses.
        test: test images with the true poses.
    """
    refined = refined_cameras(trainer.model, data.cameras, training=True)
    truth = exact.cameras.camera_to_worlds
    before, after = pose_errors(data.cameras.camera_to_worlds, truth), pose_errors(refined.camera_to_worlds, truth)
    carried = carry(test.cameras, truth, data.cameras.camera_to_worlds)  # the model refines them further
    shown = with_refined_poses(trainer.model, replace(test, cameras=carried))
    return {
        "median angle before, degrees": round(before.median_angle, 4),
        "median angle after, degrees": round(after.median_angle, 4),
        "median centre error before, of the extent": round(before.median_distance, 6),
        "median centre error after, of the extent": round(after.median_distance, 6),
        "test PSNR, dB": round(evaluate(trainer.model, shown).results["psnr"], 2),
        "steps": trainer.state.step,
    }


def carry(cameras: Cameras, truth: Tensor, given: Tensor) -> Cameras:
    """Transform cameras from the frame of the true poses to the frame of other poses, by the best similarity.

    Args:
        cameras: cameras in the frame of `truth`.
        truth: (N, 3, 4) true poses.
        given: (N, 3, 4) other poses of the same cameras.
    """
    scale, rotation, translation = align_cameras(truth, given)
    poses = cameras.camera_to_worlds.double()
    centres = scale * (poses[:, :, 3] @ rotation.T) + translation
    moved = torch.cat([rotation @ poses[:, :, :3], centres[:, :, None]], dim=-1)
    return replace(cameras, camera_to_worlds=moved.float())

"""Comparison of poses from ns-process-data with a COLMAP model of the same images, matched by name."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.pose_errors import pose_errors
from nerfloom.base.errors import DataError
from nerfloom.processing.colmap import read_model
from nerfloom.processing.transforms import opengl_pose


def compare(processed: Path, model_folder: Path) -> dict[str, Any]:
    """Compare two sets of poses, without the best similarity transform between them.

    Args:
        processed: folder with transforms.json, from ns-process-data.
        model_folder: folder with cameras.bin, images.bin and points3D.bin.

    Returns:
        Median and maximum errors, angles in degrees and centres relative to the extent of the cameras; the number of
        the model's images with a pose in the processed folder; and the summary of the processing.

    Raises:
        DataError: if there are no common images.
    """
    transforms = json.loads((processed / "transforms.json").read_text())
    processed_poses = {
        frame.get("source_path", Path(frame["file_path"]).name): np.array(frame["transform_matrix"])
        for frame in transforms["frames"]
    }
    model = read_model(lambda _: None, model_folder)
    model_poses = {name: opengl_pose(world_to_camera) for name, (_, _, world_to_camera) in model.images.items()}
    names = sorted(processed_poses.keys() & model_poses.keys())
    if not names:
        raise DataError(f"{processed} and {model_folder} have no common images; both must name images by their files")
    errors = pose_errors(
        torch.from_numpy(np.stack([processed_poses[name] for name in names])),
        torch.from_numpy(np.stack([model_poses[name] for name in names])),
    )
    summary = processed / "colmap" / "summary.json"
    return {
        "registered": len(names),
        "given": len(model_poses),
        "median_angle_degrees": errors.median_angle,
        "largest_angle_degrees": float(errors.angles.max()),
        "median_center_relative_to_extent": errors.median_distance,
        "largest_center_relative_to_extent": float(errors.distances.max()),
        "processing": json.loads(summary.read_text()) if summary.is_file() else None,
    }

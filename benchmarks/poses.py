"""Poses that ns-process-data found beside those of a COLMAP model of the same photographs, by name.

python benchmarks/poses.py --processed OUT --model DIR/sparse/0
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from framework.geometry.alignment import pose_errors
from framework.tools.processing.colmap import read_model
from framework.tools.processing.transforms import opengl_pose


def main() -> None:
    """Prints JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--processed", type=Path, required=True, help="folder with transforms.json")
    parser.add_argument("--model", type=Path, required=True, help="folder with cameras.bin, images.bin, points3D.bin")
    arguments = parser.parse_args()
    print(json.dumps(compare(arguments.processed, arguments.model), indent=2))


def compare(processed: Path, model_folder: Path) -> dict[str, Any]:
    """Median and largest errors, and how many of the model's photographs have a pose in the processed folder."""
    transforms = json.loads((processed / "transforms.json").read_text())
    found = {
        frame.get("source_path", Path(frame["file_path"]).name): np.array(frame["transform_matrix"])
        for frame in transforms["frames"]
    }
    model = read_model(lambda _: None, model_folder)
    given = {name: opengl_pose(world_to_camera) for name, (_, _, world_to_camera) in model.images.items()}
    names = sorted(found.keys() & given.keys())
    errors = pose_errors(
        torch.from_numpy(np.stack([found[name] for name in names])),
        torch.from_numpy(np.stack([given[name] for name in names])),
    )
    summary = processed / "colmap" / "summary.json"
    return {
        "registered": len(names),
        "given": len(given),
        "median_angle_degrees": errors.median_angle,
        "largest_angle_degrees": float(errors.angles.max()),
        "median_center_relative_to_extent": errors.median_distance,
        "largest_center_relative_to_extent": float(errors.distances.max()),
        "processing": json.loads(summary.read_text()) if summary.is_file() else None,
    }


if __name__ == "__main__":
    main()

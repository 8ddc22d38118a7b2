"""Export of the training cameras, with refined poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor, nn

from framework.cameras.cameras import Cameras
from framework.cameras.poses import Placement
from framework.cameras.refinement import PoseRefinement


def refined_cameras(model: nn.Module, cameras: Cameras) -> Cameras:
    """Return the training cameras, with refined poses if the model has refined them.

    Args:
        model: the trained model.
        cameras: the training cameras as given.
    """
    refinement = next((module for module in model.modules() if isinstance(module, PoseRefinement)), None)
    return cameras if refinement is None else refinement.refined(cameras)


def camera_list(cameras: Cameras, names: Sequence[str], placement: Placement) -> list[dict[str, Any]]:
    """Return file names and camera-to-world matrices (3 x 4, OpenGL axes) in the input's frame, in nerfstudio's format.

    Args:
        cameras: M cameras in the scene's frame.
        names: M file names.
        placement: the transform from the input's frame to the scene's.
    """
    poses: Tensor = placement.original_poses(cameras.camera_to_worlds.double().cpu())
    return [{"file_path": name, "transform": pose} for name, pose in zip(names, poses.tolist(), strict=True)]

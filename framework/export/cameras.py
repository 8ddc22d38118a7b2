"""The training cameras, where they are believed to be after training."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor, nn

from framework.cameras.cameras import Cameras
from framework.cameras.poses import Placement
from framework.cameras.refinement import PoseRefinement


def believed(model: nn.Module, cameras: Cameras) -> Cameras:
    """A run's training cameras, refined where the model has refined them."""
    refinement = next((module for module in model.modules() if isinstance(module, PoseRefinement)), None)
    return cameras if refinement is None else refinement.refined(cameras)


def camera_list(cameras: Cameras, names: Sequence[str], placement: Placement) -> list[dict[str, Any]]:
    """File names with camera-to-world matrices (3 x 4, OpenGL axes) of the input's frame, as nerfstudio lists them.

    Args:
        cameras: M, in the scene's frame.
        names: M file names.
        placement: of the input in the scene.
    """
    poses: Tensor = placement.original_poses(cameras.camera_to_worlds.double().cpu())
    return [{"file_path": name, "transform": pose} for name, pose in zip(names, poses.tolist(), strict=True)]

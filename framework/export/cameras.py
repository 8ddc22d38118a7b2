"""Export of the training cameras, with refined poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from framework.cameras.cameras import Cameras
from framework.cameras.poses import Placement
from framework.model import Model, RefinesPoses


def refined_cameras(model: Model[Any], cameras: Cameras) -> Cameras:
    """Return a run's training cameras, refined where the model has refined them.

    Args:
        model: the run's.
        cameras: M training cameras as they are given.
    """
    return model.refined_cameras(cameras) if isinstance(model, RefinesPoses) else cameras


def camera_list(cameras: Cameras, names: Sequence[str], placement: Placement) -> list[dict[str, Any]]:
    """Return file names and camera-to-world matrices (3 x 4, OpenGL axes) in the input's frame, in nerfstudio's format.

    Args:
        cameras: M cameras in the scene's frame.
        names: M file names.
        placement: the transform from the input's frame to the scene's.
    """
    poses: Tensor = placement.original_poses(cameras.camera_to_worlds.double().cpu())
    return [{"file_path": name, "transform": pose} for name, pose in zip(names, poses.tolist(), strict=True)]

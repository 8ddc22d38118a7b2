"""The training cameras, where they are believed to be after training."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from framework.cameras.cameras import Cameras
from framework.cameras.poses import Placement
from framework.model import Model, RefinesPoses


def believed(model: Model[Any], cameras: Cameras) -> Cameras:
    """Return a run's training cameras, refined where the model has refined them.

    Args:
        model: the run's.
        cameras: M training cameras as they are given.
    """
    return model.refined_cameras(cameras) if isinstance(model, RefinesPoses) else cameras


def camera_list(cameras: Cameras, names: Sequence[str], placement: Placement) -> list[dict[str, Any]]:
    """File names with camera-to-world matrices (3 x 4, OpenGL axes) of the input's frame, as nerfstudio lists them.

    Args:
        cameras: M, in the scene's frame.
        names: M file names.
        placement: of the input in the scene.
    """
    poses: Tensor = placement.original_poses(cameras.camera_to_worlds.double().cpu())
    return [{"file_path": name, "transform": pose} for name, pose in zip(names, poses.tolist(), strict=True)]

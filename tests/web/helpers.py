"""A few Gaussians and cameras, and pages of them and of octrees."""

import math

import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras
from nerfloom.evaluation.paths import look_at
from nerfloom.export.web import PageFacts, camera_rows, focus_of
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import OURS, Look

SIZE = (200, 150)


def some_gaussians(count: int, degree: int = 3) -> Gaussians:
    """Gaussians of all shapes in a ball."""
    torch.manual_seed(0)
    terms = (degree + 1) ** 2 - 1
    return Gaussians(
        means=0.5 * torch.randn(count, 3),
        log_scales=math.log(0.05) + torch.randn(count, 3),
        rotations=torch.randn(count, 4),
        logits=2 * torch.randn(count),
        colors=torch.randn(count, 3),
        harmonics=0.2 * torch.randn(count, 3, terms),
    )


def some_cameras(count: int = 4) -> Cameras:
    """Cameras around the origin, with different lenses; the last is turned about its axis."""
    angles = torch.arange(count) * 2.1
    up = torch.tensor([0.0, 0.0, 1.0])
    eyes = [torch.tensor([2.5 * math.cos(a), 2.5 * math.sin(a), 0.8 - 0.5 * math.sin(a)]) for a in angles.tolist()]
    poses = torch.stack([look_at(eye, torch.tensor([0.1, 0.0, 0.05]), up) for eye in eyes])
    c, s = math.cos(0.7), math.sin(0.7)
    poses[-1, :, :3] = poses[-1, :, :3] @ torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    steps = torch.arange(count).float()
    width, height = (torch.full((count,), side) for side in SIZE)
    return Cameras(poses, 180 + 10 * steps, 190 + 5 * steps, 95 + 4 * steps, 80 - 3 * steps, width, height)


def some_facts(title: str = "test", look: Look = OURS) -> PageFacts:
    """Facts about those cameras."""
    cameras, turn = some_cameras(), torch.eye(3, dtype=torch.float64)
    rows = camera_rows(cameras, ["a.png", "b.png", "c.png", "</script>"], turn)
    return PageFacts(title, "About.", (1.0, 1.0, 1.0), 0.05, look, focus_of(cameras, turn), rows)


ASLANT = torch.tensor([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]], dtype=torch.float64)
"""A rotation about no axis of the frame."""


def octree_facts(turn: Tensor) -> PageFacts:
    """Facts about those cameras, for an octree in a turned frame."""
    cameras = some_cameras()
    rows = camera_rows(cameras, ["a.png", "b.png", "c.png", "d.png"], turn)
    return PageFacts("test", "About.", (1.0, 1.0, 1.0), 0.05, None, focus_of(cameras, turn), rows)

"""Fully known teachers, and placements of an input that is far from its origin."""

import torch
from torch import Tensor, nn

from nerfloom import Field, Points, RayConfig, RayModel, Scene, VolumeRenderer
from nerfloom.cameras.poses import Placement
from nerfloom.samplers.uniform import UniformSampler

ORIGIN = torch.tensor([3e6, -2e6, 1e5], dtype=torch.float64)
"""Where the scene is in the input."""
BOX = torch.tensor([[-1.0] * 3, [1.0] * 3])
THICK, SHARP = 30.0, 20.0


def placed(seed: int, scale: float) -> Placement:
    """A random placement that puts `ORIGIN` near the scene's origin."""
    generator = torch.Generator().manual_seed(seed)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))[0]
    rotation = rotation * torch.linalg.det(rotation)
    middle = ORIGIN + 0.1 * torch.randn(3, generator=generator, dtype=torch.float64)
    return Placement(torch.cat([rotation, -(rotation @ middle)[:, None]], dim=-1), scale)


class Marble(Field):
    """Smooth density around the origin, with a colour that depends on position and direction."""

    def __init__(self) -> None:
        super().__init__()
        self.thickness = nn.Parameter(torch.tensor(THICK))

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        return self.thickness * torch.exp(-SHARP * points.positions.square().sum(-1)), points.positions

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return (0.5 + 0.2 * features + 0.2 * directions).clamp(0, 1)


def marble() -> RayModel:
    """A model of the marble in a box, with parts in closed form."""
    scene = Scene(BOX, 1.0, 5.0, num_cameras=1, has_alpha=True, moving=False, image_size=24)
    config = RayConfig(mixed_precision=False)
    return RayModel(config, scene, Marble(), UniformSampler(64), VolumeRenderer()).eval()

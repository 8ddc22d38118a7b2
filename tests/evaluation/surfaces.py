"""Surfaces with known distances."""

import numpy as np
import torch
from torch import Tensor

from nerfloom.evaluation.surfaces import Surface


def square(height: float = 0.0, half: float = 0.5, tilt: float = 0.0) -> Surface:
    """A square around the z axis at a height, turned about x by `tilt` radians."""
    x, y = torch.tensor([[-1.0, -1], [1, -1], [1, 1], [-1, 1]], dtype=torch.float64).T * half
    turn = torch.tensor(tilt, dtype=torch.float64)
    points = torch.stack([x, y * turn.cos(), y * turn.sin() + height], -1)
    return Surface(points, torch.tensor([[0, 1, 2], [0, 2, 3]]))


def together(*surfaces: Surface) -> Surface:
    """Meshes as one."""
    starts = torch.tensor([0, *(len(s.points) for s in surfaces)]).cumsum(0)
    faces = [s.faces + start for s, start in zip(surfaces, starts, strict=False) if s.faces is not None]
    return Surface(torch.cat([s.points for s in surfaces]), torch.cat(faces))


def sphere(radius: float = 1.0, level: int = 5) -> Surface:
    """A sphere of triangles with corners on it."""
    import trimesh

    made = trimesh.creation.icosphere(subdivisions=level, radius=radius)
    return Surface(tensor(made.vertices), tensor(made.faces).long())


def tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.array(values))

"""Visibility networks: they learn which points a block's training images see, so that pictures omit other blocks.

Source: Block-NeRF (Tancik et al. 2022), section 4.2, "Visibility Prediction". A small network learns the transmittance
of a point seen from a direction. It is 1 in front of surfaces, 0 behind them, and 0 where no training image has looked.

File, visibility.npz in the folder of a run: plain arrays, `center` (3,) and `radius` () float64, and the weights and
biases of the layers, float32.
"""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from nerfloom.base.archives import uncompressed_size
from nerfloom.base.atomic import write_atomically
from nerfloom.base.errors import DataError, one_line
from nerfloom.blocks.block import Vector
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.view import View

NAME = "visibility.npz"
"""Name of the file in the folder of a run."""
FREQUENCIES = 5
"""Number of frequencies of positions. The longest wave is 8 radii of the block, the shortest half a radius."""
WIDTHS = (3 * (1 + 2 * FREQUENCIES) + 3, 64, 64, 1)
"""Number of inputs, features of the hidden layers, and outputs."""
MAX_PLACE = 4.0
"""Largest coordinate of a position that the network distinguishes, radii from the block's centre."""
SHARES = (0.05, 0.1, 0.2, 0.4, 0.7, 1.0)
"""Distances along rays of a view where visibility is looked up, as shares of the reach."""
MAX_SIZE, MAX_WEIGHT = 2**17, 1e4
"""Maximum size of a file, bytes, and maximum magnitude of a weight in it."""


class Visibility(nn.Module):
    """A network for the transmittance of points, as the training images of a block have seen them.

    Args:
        center: the block's centre, in the input's frame.
        radius: the block's radius, in the input's unit.
    """

    def __init__(self, center: Vector, radius: float) -> None:
        super().__init__()
        self.center, self.radius = center, radius
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            self.layers = nn.ModuleList(nn.Linear(before, after) for before, after in pairwise(WIDTHS))

    def inputs(self, points: Tensor, directions: Tensor) -> Tensor:
        """Return the inputs (N, C) float32 of points and of the directions towards them.

        Args:
            points: (N, 3) positions in the input's frame.
            directions: (N, 3) unit directions from a camera to each point, in the input's frame.
        """
        away = points.double() - torch.tensor(self.center, dtype=torch.float64)
        places = (away / self.radius).clamp(-MAX_PLACE, MAX_PLACE).float()
        angles = (places[..., None] * (torch.pi / 4 * 2.0 ** torch.arange(FREQUENCIES))).flatten(1)
        return torch.cat([places, angles.sin(), angles.cos(), directions.float()], dim=1)

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the logits (N,) of transmittances, given `inputs` (N, C)."""
        *hidden, last = self.layers
        for layer in hidden:
            inputs = layer(inputs).relu()
        return last(inputs)[:, 0]

    @torch.no_grad()
    def of(self, points: Tensor, directions: Tensor) -> Tensor:
        """Return the transmittances (N,) of points seen from directions, in [0, 1].

        `points` and `directions` are as in `inputs`.
        """
        return torch.sigmoid(self(self.inputs(points, directions)))


def points_in_view(view: View, placement: Placement, reach: float) -> tuple[Tensor, Tensor]:
    """Return points along the rays of a view, (N, 3) float64 in the input's frame, and their directions (N, 3) there.

    Args:
        view: the camera and its pixels, in a scene.
        placement: placement of the input in the scene.
        reach: distance of the farthest points, in the input's unit.
    """
    rays = view.camera.pixel_rays(view.pixels().flatten(), 0.0, 1.0)
    origins, directions = rays.origins.cpu().double(), rays.directions.cpu().double()
    valid = directions.isfinite().all(-1)
    origins, directions = origins[valid], directions[valid]
    lengths = reach * placement.scale * torch.tensor(SHARES, dtype=torch.float64)
    points = origins[:, None] + lengths[:, None] * directions[:, None]
    along = directions[:, None].expand_as(points).reshape(-1, 3)
    return placement.original_points(points.reshape(-1, 3)), placement.original_directions(along)


def write_visibility(file: Path, network: Visibility) -> None:
    """Write a `network` to a `file`.

    Raises:
        OSError: if the file cannot be written.
    """
    arrays: dict[str, Any] = {"center": np.array(network.center), "radius": np.array(network.radius)}
    arrays |= {name: values.detach().numpy() for name, values in network.named_parameters()}
    write_atomically(file, lambda stream: np.savez(stream, **arrays))


def read_visibility(file: Path) -> Visibility:
    """Read a network from a `file`.

    Raises:
        DataError: if it cannot be read, or is damaged.
    """
    try:
        if uncompressed_size(file) > MAX_SIZE:
            raise ValueError("it is too large")
        with np.load(file, allow_pickle=False) as content:
            return _network({name: np.asarray(content[name]) for name in content.files})
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror or error}") from error
    except Exception as error:  # numpy, zipfile and zlib raise ValueError, EOFError, BadZipFile, zlib.error and more
        raise DataError(f"{file} is damaged: {one_line(error)}; remove it, and run ns-blocks again") from error


def _network(arrays: dict[str, np.ndarray]) -> Visibility:
    """Return the network of arrays; raise ValueError if they do not fit."""

    def array(name: str, shape: tuple[int, ...], kind: type) -> np.ndarray:
        found = arrays.get(name)
        if found is None or found.shape != shape or found.dtype != kind or not np.isfinite(found).all():
            raise ValueError(f"its '{name}' must be finite numbers {shape}")
        return found

    (x, y, z), radius = array("center", (3,), np.float64).tolist(), float(array("radius", (), np.float64))
    if not 0 < radius < math.inf:
        raise ValueError("its radius must be above zero")
    network = Visibility((x, y, z), radius)
    with torch.no_grad():
        for name, values in network.named_parameters():
            found = array(name, tuple(values.shape), np.float32)
            if np.abs(found).max() > MAX_WEIGHT:
                raise ValueError(f"a weight in '{name}' is larger than {MAX_WEIGHT:g}")
            values.copy_(torch.from_numpy(found))
    return network

"""A field that moves: D-NeRF (Pumarola et al. 2021), section 3."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from framework.fields.base import MLP, Field
from framework.fields.nerf import encoded_times
from framework.geometry.points import Points
from framework.kernels.contraction import contract_to_unit
from framework.kernels.frequency import frequency_encoding


class DeformedField(Field):
    """A canonical field, seen through a displacement that a network learns for every place and time.

    Args:
        canonical: the scene as it is at time 0, where the displacement is zero (equation 2).
        width, depth: features of a hidden layer, and hidden layers (256 and 8 in the paper).
        position_frequencies, time_frequencies: L of the two encodings (10 and 4 in the paper).
        contracted: (2, 3) the box around which all of space is contracted into [-1, 1]^3, so that frequencies fit;
            None to take positions as they are.
    """

    contracted: Tensor | None

    def __init__(
        self,
        canonical: Field,
        width: int = 256,
        depth: int = 8,
        position_frequencies: int = 10,
        time_frequencies: int = 4,
        contracted: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.register_buffer("contracted", None if contracted is None else contracted.clone())
        self.canonical = canonical
        self.runs_on_kernels = canonical.runs_on_kernels
        self.position_frequencies, self.time_frequencies = position_frequencies, time_frequencies
        encoded = 3 + 6 * position_frequencies + 1 + 2 * time_frequencies
        first = min(depth, 5)
        self.before_skip = MLP(encoded, *[width] * first, activation="relu")
        self.after_skip = MLP(width + encoded, *[width] * (depth - first), 3)
        last = self.after_skip[-1]
        assert isinstance(last, nn.Linear)
        nn.init.uniform_(last.weight, -1e-4, 1e-4)  # nothing moves at first
        nn.init.zeros_(last.bias)

    def displacement(self, positions: Tensor, times: Tensor | None) -> Tensor:
        """(N, 3) from where something is at its time to where it is at time 0, scene units."""
        if self.contracted is not None:
            positions = 2 * contract_to_unit(positions, self.contracted) - 1
        encoded = (
            frequency_encoding(positions, self.position_frequencies),
            encoded_times(times, self.time_frequencies),
        )
        found = self.after_skip(self.before_skip(*encoded), *encoded).float()
        assert times is not None
        return torch.where(times[:, None] == 0, torch.zeros_like(found), found)

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        moved = points.positions + self.displacement(points.positions, points.times)
        return self.canonical.density(replace(points, positions=moved, times=None))

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return self.canonical.color(features, directions, camera_indices)

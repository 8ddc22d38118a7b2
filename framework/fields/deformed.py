"""A field of a moving scene (D-NeRF, Pumarola et al. 2021, section 3)."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from nerfloom.fields.base import MLP, Field
from nerfloom.fields.nerf import encoded_times
from nerfloom.geometry.points import Points
from nerfloom.kernels.encodings.contraction import contract_to_unit
from nerfloom.kernels.encodings.frequency import frequency_encoding


class DeformedField(Field):
    """A canonical field with a learnt displacement of every position and time.

    Args:
        canonical: the field that is evaluated at displaced positions.
        width: features of a hidden layer of the displacement network (256 in the paper).
        depth: hidden layers of the displacement network (8 in the paper).
        position_frequencies: number L of frequencies of the encoded positions (10 in the paper).
        time_frequencies: number L of frequencies of the encoded times (4 in the paper).
        contracted: (2, 3) box; all of space is contracted around it into [-1, 1]^3, the range that suits the
            frequencies. None to encode scene coordinates.
        fixed_start: whether the displacement is zero at time 0, so that the canonical field is the scene at that time
            (equation 2). The network is smooth in time and cannot follow this jump: it bends all other times towards
            the best fit, and only the first image sees the undisplaced canonical field.
        ambient: number K of further outputs of the network, inputs of the canonical field (HyperNeRF, Park et al. 2021,
            section 4). They explain changes that no displacement can, such as a shadow moving over a floor. 0 in the
            paper.
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
        fixed_start: bool = True,
        ambient: int = 0,
    ) -> None:
        super().__init__()
        self.register_buffer("contracted", None if contracted is None else contracted.clone())
        self.canonical, self.fixed_start, self.ambient = canonical, fixed_start, ambient
        self.runs_on_kernels = canonical.runs_on_kernels
        self.position_frequencies, self.time_frequencies = position_frequencies, time_frequencies
        encoded = 3 + 6 * position_frequencies + 1 + 2 * time_frequencies
        first = min(depth, 5)
        self.before_skip = MLP(encoded, *[width] * first, activation="relu")
        self.after_skip = MLP(width + encoded, *[width] * (depth - first), 3 + ambient)
        last = self.after_skip[-1]
        assert isinstance(last, nn.Linear)
        nn.init.uniform_(last.weight, -1e-4, 1e-4)  # nothing moves at first
        nn.init.zeros_(last.bias)

    def deformation(self, positions: Tensor, times: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """Return the displacement (N, 3) to the canonical field, scene units, and ambient coordinates (N, K) or None.

        Args:
            positions: (N, 3) scene coordinates.
            times: (N,) in [0, 1].

        Raises:
            ValueError: if `times` is None.
        """
        if self.contracted is not None:
            positions = 2 * contract_to_unit(positions, self.contracted) - 1
        encoded = (
            frequency_encoding(positions, self.position_frequencies),
            encoded_times(times, self.time_frequencies),
        )
        outputs = self.after_skip(self.before_skip(*encoded), *encoded).float()
        assert times is not None
        moved_by = outputs[:, :3].contiguous()
        if self.fixed_start:
            moved_by = torch.where(times[:, None] == 0, torch.zeros_like(moved_by), moved_by)
        return moved_by, outputs[:, 3:].contiguous() if self.ambient else None

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        moved_by, ambient = self.deformation(points.positions, points.times)
        moved = points.positions + moved_by
        return self.canonical.density(replace(points, positions=moved, times=None, ambient=ambient))

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return self.canonical.color(features, directions, camera_indices)

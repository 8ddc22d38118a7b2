"""The NeRF field (Mildenhall et al. 2020), appendix A, figure 7."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor, nn

from nerfloom.base.config import Range, TrainConfig
from nerfloom.encodings.coarse_to_fine import OpenLevels
from nerfloom.fields.appearance import Appearance
from nerfloom.fields.base import MLP, Field
from nerfloom.geometry.points import Points
from nerfloom.kernels.encodings.contraction import contract_to_unit
from nerfloom.kernels.encodings.frequency import MAX_FREQUENCIES, frequency_encoding


@dataclass(frozen=True)
class NetworkConfig(TrainConfig):
    """Settings of a method with a network like NeRF's; the defaults are the paper's."""

    RANGES: ClassVar[dict[str, Range]] = {
        "num_layers": (3, 64),
        "hidden_width": (2, 2**14),
        "position_frequencies": (0, MAX_FREQUENCIES),
        "direction_frequencies": (0, MAX_FREQUENCIES),
    }
    num_layers: int = 8
    """Layers before the density output."""
    hidden_width: int = 256
    """Features per layer."""
    position_frequencies: int = 10
    """Number of frequencies in the encoding of positions."""
    direction_frequencies: int = 4
    """Number of frequencies in the encoding of directions."""


class NeRFField(Field):
    """A field of one large network on frequency encodings of positions and viewing directions.

    The defaults are the paper's: 8 hidden layers of 256 features with a skip connection, and one layer of 128 for the
    colour.

    Args:
        width: features of a hidden layer; the colour layer has half as many.
        depth: hidden layers before density and features.
        skip: number of hidden layers before the encoded position is concatenated again.
        position_frequencies: number L of frequencies of the encoded positions (10 in the paper).
        direction_frequencies: number L of frequencies of the encoded directions (4 in the paper).
        time_frequencies: number L of frequencies of the encoded times, a further input: T-NeRF (Pumarola et al. 2021,
            section 4); None for a static field.
        contracted: (2, 3) box; all of space is contracted around it into [-1, 1]^3, the range that suits the
            frequencies. None to encode scene coordinates.
        opening: frequencies of positions and directions open one after the other (`OpenLevels`) during this fraction of
            the training budget; 0: all are open.
        dims: number of coordinates of a position: 3, or 4 for points of the inverted sphere (NeRF++, Zhang et al.
            2020).
        appearance: the images' appearance vectors, an input of the colour layer: NeRF-W (Martin-Brualla et al. 2021),
            equation 7; None without.
    """

    contracted: Tensor | None
    runs_on_kernels = True

    def __init__(
        self,
        width: int = 256,
        depth: int = 8,
        skip: int = 5,
        position_frequencies: int = 10,
        direction_frequencies: int = 4,
        time_frequencies: int | None = None,
        contracted: Tensor | None = None,
        opening: float = 0.0,
        dims: int = 3,
        appearance: Appearance | None = None,
    ) -> None:
        super().__init__()
        self.unbounded = contracted is not None
        self.register_buffer("contracted", None if contracted is None else contracted.clone())
        self.position_frequencies = position_frequencies
        self.direction_frequencies = direction_frequencies
        self.time_frequencies = time_frequencies
        self.opening = OpenLevels(position_frequencies, 0, opening) if opening else None
        self.direction_opening = OpenLevels(direction_frequencies, 0, opening) if opening else None
        encoded = dims * (1 + 2 * position_frequencies) + (0 if time_frequencies is None else 1 + 2 * time_frequencies)
        self.before_skip = MLP(encoded, *[width] * skip, activation="relu")
        self.after_skip = MLP(width + encoded, *[width] * (depth - skip), activation="relu")
        self.sigma_head = MLP(width, 1, activation="relu")
        self.feature_head = MLP(width, width)
        self.appearance = appearance
        seen = 3 + 6 * direction_frequencies + (0 if appearance is None else appearance.size)
        self.color_head = MLP(width + seen, width // 2, 3, activation="sigmoid")
        self._initialise()

    def _initialise(self) -> None:
        """Set Glorot weights and zero biases, as in the authors' code.

        The bias of the density is positive instead: a ReLU with negative input everywhere has no gradient, and the
        image would stay empty.
        """
        for layer in self.modules():
            if isinstance(layer, nn.Linear):
                nn.init.xavier_uniform_(layer.weight)
                nn.init.zeros_(layer.bias)
                if layer.out_features == 1:
                    nn.init.constant_(layer.bias, 0.1)

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        positions = points.positions
        if self.contracted is not None:
            positions = 2 * contract_to_unit(positions, self.contracted) - 1
        encoded: tuple[Tensor, ...] = (opened_frequencies(positions, self.position_frequencies, self.opening),)
        if self.time_frequencies is not None:
            encoded += (encoded_times(points.times, self.time_frequencies),)
        hidden = self.after_skip(self.before_skip(*encoded), *encoded)
        return self.sigma_head(hidden).squeeze(-1).float(), hidden

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        encoded = opened_frequencies(directions, self.direction_frequencies, self.direction_opening)
        inputs = [self.feature_head(features), encoded]
        if self.appearance is not None:
            inputs.append(self.appearance(camera_indices, len(features)).to(encoded.dtype))
        return self.color_head(*inputs).float()


def opened_frequencies(x: Tensor, num_frequencies: int, opening: OpenLevels | None) -> Tensor:
    """Return the frequency encoding (N, D + 2 D L) of vectors; closed frequencies are 0.

    Args:
        x: (N, D) vectors; they are part of the encoding.
        num_frequencies: number L of frequencies.
        opening: the open frequencies; None if all are.
    """
    if opening is None or opening.complete:
        return frequency_encoding(x, num_frequencies)
    dims = x.shape[1]
    return opening.completed(frequency_encoding(x, opening.count), dims * (1 + 2 * num_frequencies), 2 * dims)


def encoded_times(times: Tensor | None, num_frequencies: int) -> Tensor:
    """Return the frequency encoding (N, 1 + 2 L) of times.

    Args:
        times: (N,) in [0, 1].
        num_frequencies: number L of frequencies.

    Raises:
        ValueError: if `times` is None.
    """
    if times is None:
        raise ValueError("this field changes with time: it needs the times of its positions")
    return frequency_encoding(times[:, None], num_frequencies)

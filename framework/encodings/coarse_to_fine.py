"""Levels of an encoding that open one after the other, from coarse to fine, during training.

FreeNeRF (Yang et al. 2023), section 3.2, multiplies the frequencies of NeRF's encoding by factors that rise from 0 to 1
one after the other, so that few images are first explained by smooth shapes. Here this works for every encoding with
levels: NeRF's frequencies, hash grid levels, and scales of feature planes. Closed levels are not evaluated.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn, tensor
from torch.nn.functional import pad

from nerfloom.base.device import HostValue

STEPS_PER_LEVEL = 2**10
"""Number of steps that open a level; the factors are exact in float32."""


def opened_levels(num_levels: int, first: float, progress: float) -> float:
    """Return how many levels are open: FreeNeRF, equation 5, with `first` open levels at the start.

    Level l, counted from 0, has the factor clamp(opened - l, 0, 1).

    Args:
        num_levels: number L of levels.
        first: number of levels that are open at the start.
        progress: fraction of the opening time that has passed, at least 0; from 1 on all levels are open.

    Returns:
        min(first + L progress, L), at least 0.
    """
    if progress >= 1:
        return float(num_levels)
    return min(max(first + num_levels * progress, 0.0), float(num_levels))


class OpenLevels(nn.Module):
    """The open levels of an encoding. They are saved in checkpoints; a checkpoint without them opens all levels.

    Args:
        num_levels: number of levels.
        first: number of levels that are open at the start.
        until: fraction of the training budget until all levels are open.
    """

    opened: Tensor

    def __init__(self, num_levels: int, first: int, until: float = 1.0) -> None:
        super().__init__()
        self.num_levels, self.first, self.until = num_levels, first, until
        self.register_buffer("opened", tensor(opened_levels(num_levels, first, 0.0)))
        self._opened = HostValue()

    def advance(self, progress: float) -> None:
        """Open the levels for `progress`, the fraction of the training budget that is spent."""
        share = progress / self.until
        opened = round(opened_levels(self.num_levels, self.first, share) * STEPS_PER_LEVEL) / STEPS_PER_LEVEL
        if opened != self._opened.of(self.opened):
            self._opened.change(self.opened, opened)

    @property
    def count(self) -> int:
        """Number of levels that are open, at least in part."""
        return -int(-self._opened.of(self.opened) // 1)

    @property
    def complete(self) -> bool:
        """True if all levels are open."""
        return self._opened.of(self.opened) >= self.num_levels

    def completed(self, features: Tensor, width: int, last: int | None = None) -> Tensor:
        """Pad the features of the open levels with zeros to the width of all levels.

        Args:
            features: (N, E) features, ending with the last open level.
            width: number of features of the complete encoding.
            last: number of features of the last open level; `width` over the number of levels if None.

        Returns:
            (N, width) features. The last open level is multiplied by its factor; closed levels are 0.
        """
        share = self._opened.of(self.opened) - (self.count - 1)
        if self.count and share < 1:
            factors = features.new_ones(features.shape[1])
            factors[features.shape[1] - (width // self.num_levels if last is None else last) :] = share
            features = features * factors
        return pad(features, (0, width - features.shape[1]))

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        if prefix + "opened" not in state_dict:
            state_dict = {**state_dict, prefix + "opened": tensor(float(self.num_levels))}
        super()._load_from_state_dict(state_dict, prefix, *rest)

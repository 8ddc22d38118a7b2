"""A parameter of Gaussians, of which there may be any number."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from nerfloom.base.optimised import Optimised


class Table(nn.Module):
    """One parameter of every Gaussian, with its optimiser settings.

    Args:
        width: numbers of a Gaussian.
        optimised: settings of the optimiser.
    """

    def __init__(self, width: int, optimised: Optimised) -> None:
        super().__init__()
        self.values = nn.Parameter(torch.zeros(0, width))
        self.optimised = optimised

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: object) -> None:
        saved = state_dict.get(prefix + "values")
        if saved is not None and saved.ndim == 2 and saved.shape[1] == self.values.shape[1]:
            self.values.data = self.values.new_zeros(saved.shape)
        super()._load_from_state_dict(state_dict, prefix, *rest)

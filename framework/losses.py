"""Losses: pure functions of tensors."""

from __future__ import annotations

from torch import Tensor


def mean_squared_error(prediction: Tensor, target: Tensor, weights: Tensor | None = None) -> Tensor:
    """Mean of (prediction - target)^2 over all elements. 0 for empty input, so that an empty batch is harmless.

    Args:
        prediction, target: (R, C).
        weights: (R,) what each row's part is multiplied by; None for 1.
    """
    if prediction.numel() == 0:
        return prediction.sum()
    squares = (prediction - target).square()
    return squares.mean() if weights is None else (squares * weights[:, None]).mean()

"""Shared by the tests of compiled kernels."""

import pytest
import torch

from nerfloom.kernels import native

needs_kernels = pytest.mark.skipif(not native.available(), reason="the compiled kernels are not installed")


def relative_error(value: torch.Tensor, truth: torch.Tensor) -> float:
    """Largest difference over the largest magnitude of the truth (1 if that is 0)."""
    if truth.numel() == 0:
        return 0.0
    scale = truth.abs().max().item() or 1.0
    return (value.double() - truth.double()).abs().max().item() / scale

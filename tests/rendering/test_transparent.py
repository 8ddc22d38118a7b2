"""The opacity of pixels that are known to be transparent at their time."""

import math

import pytest
import torch

from framework.geometry.rays import Rays, Samples
from framework.rendering.losses import opacity_of_transparent
from framework.rendering.volume import volume_render


def test_only_pixels_that_are_fully_transparent_count() -> None:
    """By hand: of four pixels two are transparent; weights count as those of colours do."""
    accumulation = torch.tensor([0.5, 0.25, 0.75, 1.0], requires_grad=True)
    alpha = torch.tensor([0.0, 0.0, 1 / 255, 1.0])
    loss = opacity_of_transparent(accumulation, alpha)
    assert loss.item() == pytest.approx((0.5 + 0.25) / 4)
    loss.backward()
    assert accumulation.grad is not None
    assert accumulation.grad.tolist() == [0.25, 0.25, 0.0, 0.0]
    weights = torch.tensor([1 / 3, 2.0, 5.0, 5.0])
    assert opacity_of_transparent(accumulation, alpha, weights).item() == pytest.approx((0.5 / 3 + 0.5) / 4)
    assert opacity_of_transparent(accumulation[:0], alpha[:0]).item() == 0


@pytest.mark.parametrize("fog", [1e-3, 0.1, 1.0])
def test_thin_fog_is_pushed_as_hard_as_thick(fog: float) -> None:
    """Through the renderer: the derivative of 1 - exp(-fog), where that of its square would fade with the fog."""
    rays = Rays(torch.zeros(1, 3), torch.eye(3)[:1], torch.zeros(1), torch.ones(1))
    samples = Samples.regular(torch.tensor([[0.0, 0.25, 0.5]]), torch.tensor([[0.25, 0.5, 1.0]]))
    sigma = torch.full((3,), fog, requires_grad=True)
    rendered = volume_render(rays, samples, sigma, torch.rand(3, 3), torch.rand(1, 3))
    loss = opacity_of_transparent(rendered.accumulation, torch.zeros(1))
    assert loss.item() == pytest.approx(-math.expm1(-fog), rel=1e-4)
    loss.backward()
    torch.testing.assert_close(sigma.grad, samples.deltas * math.exp(-fog))

"""The opacity of pixels that are known to be transparent at their time."""

import math

import pytest
import torch

from nerfloom.data.pixels.batch import PixelBatch, thinned
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.losses.functions import mean_squared_error, opacity_of_transparent
from nerfloom.rendering.volume import volume_render


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


def batch_of(alpha: torch.Tensor, per_pixel: int) -> PixelBatch:
    """A batch whose rays begin at (pixel, ray of the pixel, 0), with weights."""
    count = len(alpha)
    origins = torch.cartesian_prod(torch.arange(count).float(), torch.arange(per_pixel).float(), torch.zeros(1))
    rays = Rays(origins.view(-1, 3), torch.eye(3)[:1].expand(count * per_pixel, -1))
    weights = torch.linspace(0.5, 1.5, count)
    return PixelBatch(torch.arange(count), rays, torch.rand(count, 3), torch.rand(count, 3), alpha, weights=weights)


@pytest.mark.parametrize("per_pixel", [1, 4])
def test_thinning_keeps_what_is_opaque_and_all_of_a_pixel(per_pixel: int) -> None:
    torch.manual_seed(0)
    alpha = torch.tensor([0.0, 1.0, 0.0, 0.5] * 50)
    batch = batch_of(alpha, per_pixel)
    left, kept = thinned(batch, 0.25)
    assert set(kept.tolist()) >= set((alpha > 0).nonzero().squeeze(-1).tolist())
    assert 5 < int((alpha[kept] == 0).sum()) < 50
    assert torch.equal(left.pixels, batch.pixels[kept])
    assert torch.equal(left.rgb, batch.rgb[kept])
    assert left.rays_per_pixel == per_pixel
    assert torch.equal(left.rays.origins[:, 0].long(), left.pixels.repeat_interleave(per_pixel))
    assert torch.equal(left.rays.origins[:, 1].long(), torch.arange(per_pixel).repeat(len(left)))


@pytest.mark.medium
def test_a_thinned_loss_has_the_same_mean() -> None:
    """Over 1,000 draws, to four standard errors; and to the bit if nothing is left out."""
    torch.manual_seed(0)
    batch = batch_of((torch.rand(60) > 0.8).float(), 1)
    assert batch.weights is not None
    rendered = torch.rand(60, 3)
    truth = mean_squared_error(rendered, batch.rgb, batch.weights)
    found = []
    for _ in range(1000):
        left, kept = thinned(batch, 0.25)
        found.append(mean_squared_error(rendered[kept], left.rgb, left.weights))
    losses = torch.stack(found)
    assert losses.std() > 0.01
    assert (losses.mean() - truth).abs() < 4 * losses.std() / 1000**0.5
    left, kept = thinned(batch, 1.0)
    assert torch.equal(mean_squared_error(rendered[kept], left.rgb, left.weights), truth)

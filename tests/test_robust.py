"""Robust losses: their rules, quantiles and patches are those of the papers, and they leave out what moves."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch

from nerfloom.base.config import RobustConfig, from_plain
from nerfloom.base.errors import ConfigError
from nerfloom.data.pixels.batch import draw_batch
from nerfloom.data.pixels.patches import PATCH, patches_around
from nerfloom.data.pixels.pixel_set import PixelSet
from nerfloom.data.sources import Request, make_source
from nerfloom.losses.robust import (
    BINS_PER_DECADE,
    RobustColors,
    error_counts,
    error_quantile,
    image_inliers,
    inliers,
    window_side,
)
from nerfloom.losses.term import RenderedBatch
from nerfloom.losses.terms import COLOR_ERROR
from nerfloom.ray_model import RayModel
from nerfloom.registry import load_method
from nerfloom.stress.scenes import ball_views
from nerfloom.stress.variants import with_distractors
from nerfloom.training.trainer import Trainer

BALL = ball_views()
AT_ONCE: Any = from_plain(load_method("instant-ngp").config, {"robust_steps": 0}, "test")
SMALL = {
    "log2_table_size": 12,
    "max_resolution": 64,
    "num_steps": 64,
    "num_rays_per_batch": 1024,
    "samples_per_batch": None,
}
"""Settings of a small field."""
BIN = 10 ** (1 / BINS_PER_DECADE)


def by_loops(errors: np.ndarray, threshold: float, known: np.ndarray, side: int = 16) -> np.ndarray:
    """The rules of RobustNeRF at one patch or image, pixel by pixel, with tiles from a quarter of a window on."""
    height, width = errors.shape
    below = (errors < threshold) & known
    found = errors < threshold
    for row in range(height):
        for column in range(width):
            near = np.s_[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
            found[row, column] |= below[near].sum() > 0.5 * known[near].sum()
            top, left = ((place - side // 4) // (side // 2) * (side // 2) for place in (row, column))
            if min(top, left) >= 0 and top + side <= height and left + side <= width:
                around = np.s_[top : top + side, left : left + side]
                found[row, column] |= below[around].sum() > 0.6 * known[around].sum()
    return found


@pytest.mark.parametrize("side", [4, 8, 16])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("smooth", [0, 2, 5])
def test_rules_of_patches_are_those_of_the_paper(smooth: int, masked: bool, side: int) -> None:
    generator = torch.Generator().manual_seed(smooth)
    errors = torch.rand(6, 24, 32, generator=generator)
    for _ in range(smooth):  # so that there are regions of all shares
        errors = torch.nn.functional.avg_pool2d(errors, 3, 1, 1)
    known = torch.rand(errors.shape, generator=generator) < (0.6 if masked else 2.0)
    for share in (0.3, 0.55, 0.62, 0.8):
        threshold = errors.quantile(share)
        found = inliers(errors, threshold, side, known if masked else None)
        expected = [by_loops(e, float(threshold), k, side) for e, k in zip(errors.numpy(), known.numpy(), strict=True)]
        assert np.array_equal(found.numpy(), np.stack(expected))


def test_a_whole_image_has_a_tile_around_every_pixel() -> None:
    """Borders and sides that are no multiple of 8 included: padding stands for pixels that do not count."""
    generator = torch.Generator().manual_seed(0)
    errors = torch.nn.functional.avg_pool2d(torch.rand(1, 45, 161, generator=generator), 5, 1, 2)[0]
    threshold = errors.quantile(0.6)
    larger = np.full((52, 168), np.inf)  # windows of 8 around tiles of 4
    known = np.zeros_like(larger, dtype=bool)
    larger[2:47, 2:163], known[2:47, 2:163] = errors, True
    expected = by_loops(larger, float(threshold), known, 8)[2:47, 2:163]
    assert np.array_equal(image_inliers(errors, threshold).numpy(), expected)


def test_texture_counts_and_what_covers_a_region_does_not() -> None:
    errors = torch.full((80, 400), 0.01)
    errors[20:22, 10:40] = 1  # a line: an edge that is not sharp yet
    errors[34:70, 134:160] = 1  # somebody
    found = image_inliers(errors, torch.tensor(0.1))
    assert bool(found[20:22, 10:40].all())
    assert not bool(found[42:62, 142:152].any())
    assert [window_side(side) for side in (24, 100, 200, 400, 800, 4000)] == [4, 4, 8, 16, 16, 16]


@pytest.mark.parametrize("count", [256, 1024, 4096, 16_384, 65_536])
@pytest.mark.parametrize("share", [0.5, 0.8, 0.95])
def test_a_quantile_is_exact_to_a_bin(count: int, share: float) -> None:
    """Of errors over six decades, against numpy's quantile in float64."""
    errors = 10 ** (-6 * torch.rand(count, generator=torch.Generator().manual_seed(count)))
    found, exact = float(error_quantile(error_counts(errors), share)), np.quantile(errors.double().numpy(), share)
    assert exact / BIN**1.5 < found < exact * BIN**1.5


@pytest.mark.parametrize("count", [256, 1024, 4096, 16_384, 65_536])
def test_a_running_quantile_follows_batches_of_any_size(count: int) -> None:
    """Patches have errors of their own, so a single one says little of the quantile: the histogram remembers many."""
    generator = torch.Generator().manual_seed(count)
    robust, batch = (
        RobustColors(AT_ONCE),
        draw_batch(BALL.train, count, "black", patches=True),
    )
    assert len(batch) == count
    exact: list[float] = []
    found: list[float] = []
    for _ in range(200):
        of_patch = 10 ** (2 * torch.rand(batch.patches, 1, generator=generator) - 4)
        errors = (of_patch * (0.5 + torch.rand(batch.patches, PATCH**2, generator=generator))).view(-1)
        robust.pixel_weights(batch.rgb + errors.sqrt()[:, None], batch)
        exact.append(float(errors.quantile(0.8)))
        found.append(float(robust.threshold))
    wanted = np.log10(1e-2) - 0.4 + np.log10(1.0)  # the 0.8 quantile of the patches' own errors, log-uniform
    assert abs(np.mean(np.log10(found[100:])) - wanted) < 0.1
    assert np.std(np.log10(found[100:])) < 0.15
    if count == 256:
        assert np.std(np.log10(exact)) > 0.12  # of one batch alone


def test_a_quantile_of_what_is_not_finite_or_does_not_count() -> None:
    errors = torch.tensor([math.nan, math.inf, 0.0, 1e-3, 1e-3, 1e-3, 5.0])
    counted = torch.tensor([True, True, True, True, True, False, True])
    assert float(error_counts(errors, counted).sum()) == 6
    assert float(error_quantile(error_counts(errors, counted), 0.5)) == pytest.approx(1e-3, rel=0.02)


@pytest.mark.parametrize("stride", [1, 3])
def test_patches_are_whole_and_start_in_their_image(stride: int) -> None:
    cameras = BALL.train.cameras
    sizes = dataclasses.replace(
        cameras,
        widths=torch.tensor([40, 9, 16] * 4),
        heights=torch.tensor([17, 50, 3] * 4),
    )
    pixels = torch.randint(int(sizes.offsets[-1]), (500,), generator=torch.Generator().manual_seed(0))
    found = patches_around(pixels, sizes, stride).view(-1, PATCH, PATCH)
    images = torch.searchsorted(sizes.offsets, found, right=True) - 1
    assert bool((images == images[:, :1, :1]).all())
    within, widths = found - sizes.offsets[images], sizes.widths[images]
    rows, columns = within // widths, within % widths
    inner = (found == pixels[:, None, None]).flatten(1).any(1)
    assert bool(inner.all()) if stride == 1 else float(inner.float().mean()) > 0.3  # others were moved inside
    for places, lengths, axis in ((rows, sizes.heights, 1), (columns, sizes.widths, 2)):
        steps = places.diff(dim=axis)
        whole = lengths[images[:, 0, 0]] > stride * (PATCH - 1)
        assert bool((steps[whole] == stride).all())
        assert bool((steps >= 0).all())
        assert bool((places < lengths[images]).all())


def test_masked_pixels_of_a_patch_do_not_count_and_keypoints_follow() -> None:
    mask = torch.zeros(len(BALL.train.pixels), dtype=torch.bool)
    mask[::3] = mask[1::7] = True
    kept = PixelSet.of_mask(mask)
    dataset = dataclasses.replace(BALL.train, kept=kept, drawn=kept)
    batch = draw_batch(dataset, 3 * PATCH**2 + 4, "black", patches=True)
    assert batch.patches == 3
    assert len(batch) == 3 * PATCH**2
    assert batch.weights is not None
    assert torch.equal(batch.weights > 0, mask[batch.pixels])
    assert float(batch.weights.mean()) == pytest.approx(1, rel=1e-5)
    part = batch[torch.arange(10)]
    assert (part.patches, len(part)) == (0, 10)
    robust = RobustColors(AT_ONCE)
    weights = robust.pixel_weights(part.rgb + torch.linspace(0, 1, 10)[:, None], part)  # single pixels
    assert float(weights[9]) == 0
    assert part.weights is not None
    assert torch.equal(weights[:4], part.weights[:4])


def test_an_error_without_the_pixels_left_out_has_their_gradient_zero() -> None:
    """The value and gradient of the colour term are those of the masked mean square, in float64."""
    method = load_method("vanilla-nerf")
    config = dataclasses.replace(method.config, robust="percentile", robust_steps=0)
    data = with_distractors(BALL.train, 0.2)
    model, batch = method.build(config, data.scene), draw_batch(data, 1024, "black", patches=True)
    assert isinstance(model, RayModel)
    rgb = (0.5 + 0.2 * torch.rand(len(batch), 3)).requires_grad_()
    rendered = dataclasses.replace(model.render(batch.rays, batch.background), rgb=rgb)
    shown = RenderedBatch(batch, rendered, model, 0)
    value = COLOR_ERROR(shown)
    assert value is not None
    value.backward()
    assert rgb.grad is not None
    wide, target = rgb.detach().double(), batch.rgb.double()
    errors = (wide - target).square().mean(-1)
    threshold = np.quantile(errors.numpy(), config.robust_quantile)
    every = np.stack(
        [by_loops(e, threshold, np.ones((PATCH, PATCH), bool)) for e in errors.view(-1, PATCH, PATCH).numpy()]
    )
    left = torch.from_numpy(every.reshape(-1))
    assert 0 < float((~left).double().mean()) < 0.25
    same = (left == (rgb.grad.abs().sum(-1) > 0)).double().mean()  # a bin's width apart from the exact quantile
    assert float(same) > 0.99
    counted = rgb.grad.abs().sum(-1) > 0
    expected = 2 * (wide - target) * counted[:, None] / target.numel()
    torch.testing.assert_close(rgb.grad.double(), expected, rtol=1e-5, atol=1e-9)
    assert float(value.detach()) == pytest.approx(float((errors * counted).mean()), rel=1e-5)


def test_a_step_in_one_native_call_has_the_same_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its value is the weighted mean square of its own colours, with the weights that the rule gave."""
    given: list[torch.Tensor] = []
    made = RobustColors.pixel_weights

    def kept(*arguments: Any, **named: Any) -> torch.Tensor:
        given.append(made(*arguments, **named))
        return given[-1]

    monkeypatch.setattr(RobustColors, "pixel_weights", kept)
    method = load_method("instant-ngp")
    config = from_plain(method.config, {**SMALL, "robust": "percentile", "robust_steps": 0, "vis": "none"}, "test")
    trainer = Trainer(method, config, with_distractors(BALL.train, 0.2))
    for _ in range(30):
        trainer.train_step()
    batch = trainer.source.draw(Request(30, 1024))
    loss = trainer.model.loss(batch, 30)
    assert len(given) == 31
    squares = (loss.rgb - batch.rgb).square().mean(-1)
    assert 0 < float((given[-1] == 0).float().mean()) < 0.5
    assert float(loss.total.detach()) == pytest.approx(float((squares * given[-1]).mean()), rel=1e-4)


def test_at_first_all_pixels_count_and_later_only_those_that_agree() -> None:
    config = from_plain(load_method("instant-ngp").config, {"robust": "percentile", "robust_steps": 100}, "test")
    assert isinstance(config, RobustConfig)
    robust, target = RobustColors(config), torch.zeros(80, 80, 3)
    rgb = target + 0.01
    rgb[20:60, 20:60] = 0.5
    assert [robust.waits(step) for step in (0, 99, 100)] == [True, True, False]
    found = robust.image_pixels(rgb, target, None)
    assert not bool(found[28:52, 28:52].any())
    assert bool(found[:18].all())
    masked = torch.ones(80, 80, dtype=torch.bool)
    masked[:10] = False
    assert not bool(robust.image_pixels(rgb, target, masked)[:10].any())
    source = make_source("pixels", BALL.train, config)
    single, patches = (source.draw(Request(step, 256)) for step in (99, 100))
    assert (single.patches, patches.patches) == (0, 16)


def test_what_contradicts_the_setting_is_refused() -> None:
    config = dataclasses.replace(load_method("instant-ngp").config, robust="percentile", draw_by_error=True)
    with pytest.raises(ConfigError, match="--draw-by-error prefers large errors"):
        make_source("pixels", BALL.train, config)
    with pytest.raises(ConfigError, match="--robust-quantile is 0; it must be from"):
        dataclasses.replace(config, robust_quantile=0)

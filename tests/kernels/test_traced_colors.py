"""Colours of traced rays in one call, against single operations and float64, and pictures of them."""

from pathlib import Path

import pytest
import torch

from nerfloom.data.dataset import Dataset
from nerfloom.kernels.traced.colors import TRACED_COLORS, traced_colors, traced_colors_reference
from nerfloom.rendering.traced import traced_rays
from nerfloom.samplers.occupancy import OccupancySampler
from tests.kernels.compiled import needs_kernels
from tests.kernels.test_traced_error import CASES, Case, field_of, marched, parts, rays
from tests.training.test_graphs import small

pytestmark = needs_kernels


@torch.no_grad()
@pytest.mark.parametrize("bfloat16", [False, True])
@pytest.mark.parametrize("case", CASES, ids=str)
def test_what_is_shown_is_that_of_single_operations(case: Case, bfloat16: bool) -> None:
    torch.manual_seed(1)
    lines, background = rays(case.rays), torch.rand(case.rays, 3)
    density, color = parts(field_of(case))
    with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
        ours = traced_colors(marched(case, lines), density, color, background)
        theirs = traced_colors_reference(marched(case, lines), density, color, background)
    assert ours.num_samples == theirs.num_samples > case.rays / 2
    for name in ("color", "opacity", "moment"):
        torch.testing.assert_close(getattr(ours, name), getattr(theirs, name), rtol=1e-4, atol=1e-5)
    # Where the transmittance is half behind a sample, rounding decides which one is the median.
    apart = (ours.median - theirs.median).nan_to_num().abs() > 1e-3  # infinite where nothing is
    assert float(apart.double().mean()) < 0.01


@torch.no_grad()
@pytest.mark.parametrize("case", CASES[:4], ids=str)
def test_what_is_shown_is_that_of_float64(case: Case) -> None:
    torch.manual_seed(1)
    lines, background = rays(case.rays), torch.rand(case.rays, 3)
    field, exact = field_of(case), field_of(case).double()
    ours = traced_colors(marched(case, lines), *parts(field), background)
    theirs = traced_colors_reference(marched(case, lines), *parts(exact), background.double())
    torch.testing.assert_close(ours.color.double(), theirs.color.double(), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(ours.opacity.double(), theirs.opacity.double(), rtol=1e-3, atol=1e-4)


@torch.no_grad()
def test_nan_is_seen_where_single_operations_see_it_and_where_nothing_is_the_background_shows() -> None:
    case = Case()
    torch.manual_seed(1)
    lines, background = rays(case.rays), torch.rand(case.rays, 3)
    field = field_of(case)
    whole = traced_colors(marched(case, lines), *parts(field), background)
    empty = whole.opacity == 0
    assert bool(empty.any())
    assert torch.equal(whole.color[empty], background[empty])
    assert torch.equal(whole.median[empty], lines.fars[empty])
    field.encoding.table[::50] = torch.nan
    damaged = traced_colors(marched(case, lines), *parts(field), background)
    reference = traced_colors_reference(marched(case, lines), *parts(field), background)
    assert bool(damaged.color.isnan().any())
    assert torch.equal(damaged.color.isnan(), reference.color.isnan())
    torch.testing.assert_close(damaged.color, reference.color, rtol=1e-4, atol=1e-5, equal_nan=True)


def test_with_gradients_single_operations_are_taken() -> None:
    case = Case()
    march_of, (density, color) = marched(case, rays(case.rays)), parts(field_of(case))
    background = torch.rand(case.rays, 3)
    tensors = (march_of.rays.origins, density.table, *density.weights, *color.weights, background)
    assert TRACED_COLORS.choose(tensors, march_of, density, color, background).backend.name == "reference"
    with torch.no_grad():
        assert TRACED_COLORS.choose(tensors, march_of, density, color, background).backend.name == "c++"


@torch.no_grad()
def test_a_picture_is_what_its_rays_are_rendered_as(tmp_path: Path) -> None:
    trainer = small(tmp_path, "instant-ngp")
    trainer.prepare()
    model = trainer.model.eval()
    assert isinstance(model.sampler, OccupancySampler)
    dataset: Dataset = trainer.train_set
    lines = dataset.cameras.pixel_rays(torch.arange(200), 0.1, 10.0)
    known = traced_rays(lines, torch.ones(3), model.sampler, model.field, model.renderer)
    assert known is not None
    usual = model.render(lines, torch.ones(3))
    for name in ("rgb", "depth", "accumulation"):
        torch.testing.assert_close(getattr(known, name), getattr(usual, name), rtol=1e-3, atol=1e-4)
    assert known.num_samples == usual.num_samples
    model.train()
    assert traced_rays(lines, torch.ones(3), model.sampler, model.field, model.renderer) is None

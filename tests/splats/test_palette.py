"""Codebooks and palettes: errors stay below the stated bounds, and the same values have the same palette."""

import numpy as np
import pytest
import torch

from nerfloom.splats.palette import CODES, codebook, nearest_codes, palette


@pytest.mark.parametrize("kind", ["normal", "outlier", "few", "one"])
def test_codes_are_off_by_the_range_over_255_at_most(kind: str) -> None:
    random = np.random.default_rng(0)
    values = {
        "normal": random.normal(size=(500, 3)),
        "outlier": np.append(random.normal(size=999), 50.0),
        "few": np.array([-1.0, 3.0]),
        "one": np.full(7, 2.5),
    }[kind].astype(np.float32)
    codes = codebook(values)
    assert codes.shape == (CODES,)
    assert (np.diff(codes) >= 0).all()
    indices = nearest_codes(values, codes)
    assert indices.shape == values.shape
    off = np.abs(codes[indices].astype(np.float64) - values)
    print(f"{kind}: off by up to {off.max():.2g}, {np.ptp(values) / 255:.2g} is allowed")
    assert off.max() <= np.ptp(values) / 255 + 1e-5
    brute = np.abs(codes.astype(np.float64) - values.reshape(-1, 1)).min(1)
    np.testing.assert_allclose(off.reshape(-1), brute, rtol=0, atol=1e-12)  # no other code is nearer


def test_where_values_are_dense_codes_are_too() -> None:
    values = np.concatenate([np.linspace(0, 1, 10_000), [100.0]])
    codes = codebook(values)
    off = np.abs(codes[nearest_codes(values, codes)] - values)
    assert off[:-1].max() < 0.02
    assert off.max() <= 100 / 255


def test_small_sets_are_their_own_palette() -> None:
    vectors = torch.randn(50, 9, generator=torch.Generator().manual_seed(0))
    for size in (50, 64):
        entries, labels = palette(vectors, size)
        assert torch.equal(entries[labels], vectors)


def test_more_entries_leave_less_error() -> None:
    vectors = torch.randn(4000, 9, generator=torch.Generator().manual_seed(0))
    errors = []
    for size in (1, 16, 256, 2048):
        entries, labels = palette(vectors, size)
        assert len(entries) <= size
        assert int(labels.min()) >= 0
        assert int(labels.max()) < len(entries)
        errors.append(float((entries[labels] - vectors).square().mean().sqrt()))
    print("RMS errors", errors)
    assert errors[0] == pytest.approx(float((vectors - vectors.mean(0)).square().mean().sqrt()), rel=1e-5)
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.6 * errors[0]
    again = palette(vectors, 256)
    assert all(torch.equal(one, other) for one, other in zip(again, palette(vectors, 256), strict=True))


def test_clumps_are_found() -> None:
    random = torch.Generator().manual_seed(0)
    middles = 10 * torch.randn(16, 9, generator=random)
    vectors = middles.repeat(200, 1) + 0.01 * torch.randn(3200, 9, generator=random)
    entries, labels = palette(vectors, 512)
    assert float((entries[labels] - vectors).square().mean().sqrt()) < 0.03

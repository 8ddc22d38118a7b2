"""Frequency encoding and spherical harmonics against numpy, scipy and integrals."""

import numpy as np
import pytest
import torch
from scipy import special

from nerfloom.kernels.encodings.frequency import frequency_encoding
from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics


def unit_vectors(count: int) -> torch.Tensor:
    v = torch.randn(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return v / v.norm(dim=-1, keepdim=True)


def real_harmonic(degree: int, order: int, directions: torch.Tensor) -> np.ndarray:
    """A real harmonic from scipy's complex ones, with their Condon-Shortley phase."""
    x, y, z = directions.numpy().T
    polar, azimuth = np.arccos(z), np.arctan2(y, x)
    if hasattr(special, "sph_harm_y"):
        value = special.sph_harm_y(degree, abs(order), polar, azimuth)
    else:
        value = special.sph_harm(abs(order), degree, azimuth, polar)
    if order == 0:
        return value.real
    return np.sqrt(2) * (value.real if order > 0 else value.imag)


def test_spherical_harmonics_equal_scipys() -> None:
    directions = unit_vectors(500)
    found = spherical_harmonics(directions, 4).numpy()
    orders = [(degree, order) for degree in range(4) for order in range(-degree, degree + 1)]
    expected = np.stack([real_harmonic(degree, order, directions) for degree, order in orders], axis=-1)
    error = np.abs(found - expected).max()
    print(f"spherical harmonics: off scipy's by {error:.1e}")
    assert error < 1e-14


def test_spherical_harmonics_are_orthonormal() -> None:
    """Gauss-Legendre in z times the trapezoid rule in azimuth integrates products of degree 6 exactly."""
    z, weight = np.polynomial.legendre.leggauss(8)
    azimuth = np.arange(16) * 2 * np.pi / 16
    z, azimuth = (a.ravel() for a in np.meshgrid(z, azimuth, indexing="ij"))
    radius = np.sqrt(1 - z**2)
    values = spherical_harmonics(torch.tensor(np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], -1)), 4)
    weights = torch.tensor(np.repeat(weight, 16) * 2 * np.pi / 16)
    gram = values.T @ (weights[:, None] * values)
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), atol=1e-13, rtol=0)


@pytest.mark.parametrize("levels", [0, 5])
def test_other_numbers_of_levels_are_refused(levels: int) -> None:
    with pytest.raises(ValueError, match="1 to 4 levels"):
        spherical_harmonics(unit_vectors(2), levels)


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float64, 1e-13), (torch.float32, 5e-5)])
def test_frequency_encoding_equals_numpys(dtype: torch.dtype, bound: float) -> None:
    x = (torch.rand(100, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 3 - 1.5).to(dtype)
    found = frequency_encoding(x, 10).double().numpy()
    truth = x.double().numpy()
    parts = [truth] + [wave(2.0**k * truth) for k in range(10) for wave in (np.sin, np.cos)]
    error = np.abs(found - np.concatenate(parts, axis=-1)).max()
    print(f"frequency encoding, {dtype}: off numpy's by {error:.1e}")
    assert error < bound


def test_frequency_encoding_shapes() -> None:
    assert frequency_encoding(torch.zeros(0, 3), 10).shape == (0, 63)
    assert frequency_encoding(torch.zeros(4, 3), 4, include_input=False).shape == (4, 24)
    assert frequency_encoding(torch.zeros(4, 3), 0).shape == (4, 3)

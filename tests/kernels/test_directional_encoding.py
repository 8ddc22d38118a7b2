"""The integrated directional encoding against scipy, Monte Carlo over its distributions, and finite differences."""

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from nerfloom.kernels.encodings.integrated_directional import (
    MAX_BANDS,
    degrees,
    directional_encoding,
    directional_encoding_reference,
    num_features,
)
from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics
from tests.kernels.compiled import needs_kernels, relative_error
from tests.kernels.test_encodings_against_scipy import real_harmonic, unit_vectors

ROUGHNESSES = (1e-4, 1e-3, 1e-2, 0.1, 1.0, 10.0)


def sharp(directions: torch.Tensor) -> torch.Tensor:
    return directional_encoding_reference(directions, torch.zeros(len(directions), dtype=directions.dtype))


def test_without_roughness_it_is_scipys_harmonics() -> None:
    directions = unit_vectors(300)
    orders = [(degree, order) for degree in degrees(MAX_BANDS) for order in range(-degree, degree + 1)]
    expected = np.stack([real_harmonic(degree, order, directions) for degree, order in orders], axis=-1)
    error = np.abs(sharp(directions).numpy() - expected).max()
    print(f"directional encoding: off scipy's harmonics by {error:.1e}")
    assert expected.shape[1] == num_features(MAX_BANDS) == 67
    assert error < 1e-12


def test_its_first_bands_are_those_of_spherical_harmonics() -> None:
    directions = unit_vectors(50)
    torch.testing.assert_close(sharp(directions)[:, :8], spherical_harmonics(directions, 3)[:, 1:])


def drawn(mean: torch.Tensor, kappa: float, count: int) -> torch.Tensor:
    """Directions (count, 3) of the von Mises-Fisher distribution, float64: the inverse of its distribution of cosines
    (Wood 1994, in three dimensions), at evenly spaced ranks; the angles around the mean come from a lattice."""
    ranks = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    cosines = 1 + torch.log(ranks + (1 - ranks) * np.exp(-2 * kappa)) / kappa
    angles = 2 * np.pi * torch.frac(torch.arange(count, dtype=torch.float64) * (5**0.5 - 1) / 2)
    sines = (1 - cosines.square()).clamp(min=0).sqrt()
    basis = torch.linalg.qr(torch.cat([mean[:, None], torch.eye(3, dtype=torch.float64)[:, :2]], -1)).Q
    across = sines[:, None] * (angles.cos()[:, None] * basis[:, 1] + angles.sin()[:, None] * basis[:, 2])
    return cosines[:, None] * mean + across


leggauss = cache(np.polynomial.legendre.leggauss)


def exact_factor(degree: int, kappa: float) -> float:
    """The mean of Legendre's polynomial over the distribution, by Gauss-Legendre integration."""
    nodes, weights = leggauss(2000)
    kept = weights * np.exp(kappa * (nodes - 1))
    return float((kept * np.polynomial.legendre.Legendre.basis(degree)(nodes)).sum() / kept.sum())


@pytest.mark.medium
@pytest.mark.parametrize("roughness", ROUGHNESSES)
def test_means_over_distributions(roughness: float) -> None:
    """Equation 7 holds exactly with the distribution's own factor, and equation 8 is near it."""
    mean = unit_vectors(3)[1]
    truth = sharp(drawn(mean, 1 / roughness, 50_000)).mean(0)
    sizes = [2 * degree + 1 for degree in degrees(MAX_BANDS)]
    factors = torch.tensor([exact_factor(degree, 1 / roughness) for degree in degrees(MAX_BANDS)], dtype=torch.float64)
    harmonics = sharp(mean[None])[0]
    assert (truth - harmonics * factors.repeat_interleave(torch.tensor(sizes))).abs().max() < 1e-3
    found = directional_encoding(mean[None], torch.tensor([roughness], dtype=torch.float64))[0]
    bands = zip(*(each.split(sizes) for each in (found, truth, harmonics)), strict=True)
    apart = [((a - b).norm() / whole.norm()).item() for a, b, whole in bands]
    print(f"roughness {roughness:g}: attenuation off by {max(apart):.1e}")
    assert max(apart) < (5e-3 if roughness <= 1e-2 else 0.1)


def test_rougher_surfaces_show_less() -> None:
    directions = unit_vectors(20).float()
    sizes = [directional_encoding(directions, torch.full((20,), rough)).norm(dim=-1) for rough in (0.0, *ROUGHNESSES)]
    assert all(bool((more > less).all()) for more, less in pairwise(sizes))
    assert torch.equal(directional_encoding(directions, torch.full((20,), 1e4)).abs() < 1e-6, torch.ones(20, 67) > 0)


@pytest.mark.parametrize("bands", [0, 6])
def test_other_numbers_of_bands_are_refused(bands: int) -> None:
    with pytest.raises(ValueError, match="1 to 5 bands"):
        directional_encoding(unit_vectors(2), torch.zeros(2), bands)


@pytest.mark.parametrize("bands", [1, 2, MAX_BANDS])
def test_gradients_of_the_reference(bands: int) -> None:
    roughness = torch.tensor([0.0, 1e-3, 0.1, 2.0], dtype=torch.float64, requires_grad=True)
    directions = unit_vectors(4).requires_grad_()
    assert torch.autograd.gradcheck(lambda d, r: directional_encoding(d, r, bands), (directions, roughness))
    assert torch.autograd.gradgradcheck(lambda d, r: directional_encoding(d, r, min(bands, 2)), (directions, roughness))


@needs_kernels
@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 1000])
@pytest.mark.parametrize("bands", range(1, MAX_BANDS + 1))
def test_the_compiled_form(bands: int, count: int) -> None:
    torch.manual_seed(count)
    directions = normalize(torch.randn(count, 3), dim=-1)
    if count > 3:
        directions[:3] = torch.tensor([[0.0, 0, 1], [0, 0, -1], [1, 0, 0]])  # poles, and on the equator
    roughness = torch.tensor(ROUGHNESSES).repeat(count // 6 + 1)[:count]
    weights = torch.randn(count, num_features(bands), dtype=torch.float64)
    found = []
    for form, kind in ((directional_encoding, torch.float32), (directional_encoding_reference, torch.float64)):
        leaves = [each.to(kind).requires_grad_() for each in (directions, roughness)]
        out = form(*leaves, bands)
        found.append((out, *torch.autograd.grad((out * weights).sum(), leaves)))
    errors = [relative_error(value, truth) for value, truth in zip(*found, strict=True)]
    print(f"{bands} bands of {count}: value off by {errors[0]:.1e}, gradients by {errors[1]:.1e} and {errors[2]:.1e}")
    assert max(errors) < 5e-6


def test_half_precision_is_widened() -> None:
    directions = unit_vectors(5).half()
    assert directional_encoding(directions, torch.zeros(5).half()).dtype == torch.float32

"""Compositing and distortion: packed rays of any length, and rays of the same."""

import math

import pytest
import torch
from torch import Tensor

from nerfloom.geometry.rays import Samples
from nerfloom.kernels.compositing.alpha import composite_alpha
from nerfloom.kernels.compositing.density import composite, distortion
from tests.kernels.triton.compared import compare


def rays(counts: list[int]) -> tuple[Tensor, dict[str, Tensor]]:
    """Offsets, and all else that compositing takes; densities let about half of the light through."""
    torch.manual_seed(0)
    offsets = torch.nn.functional.pad(torch.tensor(counts, dtype=torch.int64).cumsum(0), (1, 0))
    count = int(offsets[-1])
    starts = torch.rand(count).cumsum(0) / 4
    return offsets, {
        "sigma": torch.rand(count) * 10 / max([*counts, 1]), "rgb": torch.rand(count, 3), "starts": starts,
        "ends": starts + torch.rand(count) / 4, "background": torch.rand(len(counts), 3),
        "fars": torch.full((len(counts),), 1e3),
    }  # fmt: skip


def composited(offsets: Tensor, points: bool = False):
    def run(sigma, rgb, starts, ends, background, fars):
        samples = Samples(starts, ends, offsets.to(sigma.device), starts + 0.01 if points else None)
        found = composite(samples, sigma, rgb, background, fars)
        return found.color, found.opacity, found.weights, found.moment, found.median

    return run


@pytest.mark.parametrize("counts", [[], [0, 0, 0], [1], [5, 0, 33, 64, 1], [32] * 2], ids=str)
def test_compositing(counts: list[int]) -> None:
    offsets, given = rays(counts)
    compare(composited(offsets, points=len(counts) == 2), given, "sigma rgb")


EXTREMES = {
    "opaque": ([1e9, 1.0, 1e9, 0.0, 3.0, 1.0], None),
    "nothing": ([0.0] * 6, None),
    "thin": ([1e-9, 1e-20, 1e-38, 1e-8, 1e-7, 1e-9], None),
    "infinite": ([math.inf, 1.0, 2.0, math.inf, 0.0, math.inf], None),
    "endless": ([0.0, 1.0, 0.5, 0.1, 0.2, 1e-3], math.inf),
    "broken": ([1.0, math.nan, 1.0, 2.0, 3.0, 1.0], None),
}


@pytest.mark.parametrize("name", EXTREMES)
def test_extremes_of_compositing(name: str) -> None:
    densities, last = EXTREMES[name]
    offsets, given = rays([3, 3])
    given["sigma"] = torch.tensor(densities)
    given["ends"][1] = given["starts"][1]  # an empty interval
    if last is not None:
        given["ends"][[2, 5]] = last
    compare(composited(offsets), given, "sigma rgb")


def test_alphas_are_composited_too() -> None:
    offsets, given = rays([3, 0, 40])

    def run(sigma, rgb, starts, ends, background, fars):
        samples = Samples(starts, ends, offsets.to(sigma.device))
        return composite_alpha(samples, sigma.clamp(max=1), rgb, background, fars)[:2]

    compare(run, given, "sigma rgb")


def test_what_is_behind_a_wall_gets_no_light_and_no_rounding_errors() -> None:
    """A sample of depth 1000 between two thin ones: in front of it transmittance is exp(-0.1), to the last digit."""
    offsets, given = rays([3])
    given["starts"], given["ends"] = torch.arange(3.0), torch.arange(3.0) + 1
    given["sigma"] = torch.tensor([0.1, 1000.0, 0.1])
    *_, weights, _, _ = compare(composited(offsets), given, "sigma rgb")[:5]
    assert abs(weights[1].item() - math.exp(-0.1)) < 1e-7
    assert weights[2] == 0


@pytest.mark.parametrize("counts", [[], [0, 0], [1], [5, 0, 33, 70]], ids=str)
def test_distortion(counts: list[int]) -> None:
    offsets, given = rays(counts)
    weights = {"weights": given["sigma"], "starts": given["starts"], "ends": given["ends"]}

    def run(weights, starts, ends):
        return distortion(weights, Samples(starts, ends, offsets.to(starts.device)))

    compare(run, weights, "weights")
    weights["starts"], weights["ends"] = weights["starts"] + 1e3, weights["ends"] + 1e3  # far away
    compare(run, weights, "weights")

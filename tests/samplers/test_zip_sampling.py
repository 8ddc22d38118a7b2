"""Zip-NeRF's parts of proposals: the power ladder, frustums for densities that ask for them, and the blurred loss."""

import pytest
import torch
from torch import Tensor

from nerfloom.fields.base import Field
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Histogram, Rays, Samples
from nerfloom.kernels.histograms.spacing import inverse_power_ladder, power_ladder, spacing
from nerfloom.kernels.histograms.step_functions import blurred_excess_reference
from nerfloom.samplers.proposal import ProposalSampler, interlevel_loss, propose

BOX = torch.tensor([[-1.0] * 3, [1.0] * 3])
DISTANCES = torch.logspace(-6, 3, 100, dtype=torch.float64)


@pytest.mark.parametrize(
    ("power", "truth"),
    [
        (1, lambda x: x),
        (0, torch.log1p),
        (-1, lambda x: 2 * (1 - 1 / (x / 2 + 1))),
        (0.5, lambda x: (2 * x + 1).sqrt() - 1),
    ],
)
def test_ladders_of_known_exponents_are_their_functions(power: float, truth) -> None:
    torch.testing.assert_close(power_ladder(DISTANCES, power), truth(DISTANCES), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("power", [1, 0.5, 1e-3, 0, -1e-3, -1, -1.5, -10])
def test_a_ladder_is_inverted_and_has_a_slope_of_one_at_the_camera(power: float) -> None:
    x = DISTANCES if power > -5 else DISTANCES[DISTANCES < 10]
    torch.testing.assert_close(inverse_power_ladder(power_ladder(x, power), power), x, rtol=1e-6, atol=1e-12)
    zero = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(power_ladder(zero, power), zero)
    assert slope.item() == pytest.approx(1)


def test_ladders_near_zero_are_the_logarithm() -> None:
    for power in (1e-6, -1e-6):
        torch.testing.assert_close(power_ladder(DISTANCES, power), torch.log1p(DISTANCES), rtol=1e-4, atol=0)


def test_a_ladder_is_bounded_and_its_far_end_finite() -> None:
    ends = power_ladder(torch.tensor([0.0, torch.inf]), -1.5)
    assert ends.tolist() == pytest.approx([0, 2.5 / 1.5])
    t = inverse_power_ladder(ends, -1.5)
    assert t[0] == 0
    assert 1e3 < t[1].item() < torch.inf
    with pytest.raises(ValueError, match="at most 1, not 2"):
        power_ladder(DISTANCES, 2)


def test_spacing_by_the_ladder_meets_both_ends_and_is_the_papers_between() -> None:
    nears, fars = torch.tensor([0.1, 0.0], dtype=torch.float64), torch.tensor([50.0, 1e6], dtype=torch.float64)
    edges = torch.linspace(0, 1, 9, dtype=torch.float64).expand(2, -1)
    t = spacing(nears, fars, 0.8, -1.5)(edges)
    torch.testing.assert_close(t[:, 0], nears, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(t[:, -1], fars, rtol=1e-3, atol=0)

    def ladder(t: Tensor) -> Tensor:  # the paper's equation, of twice the distance
        return (2.5 / -1.5) * ((2 * t / 0.8 / 2.5 + 1) ** -1.5 - 1)

    low, high = ladder(nears)[:, None], ladder(fars)[:, None]
    torch.testing.assert_close((ladder(t) - low) / (high - low), edges, rtol=1e-9, atol=1e-9)


class Fog(Field):
    """Even fog, which records its points."""

    def __init__(self, footprint: str) -> None:
        super().__init__()
        self.footprint = footprint
        self.seen: list[Points] = []

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        self.seen.append(points)
        return torch.ones(len(points)), points.positions

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return features


def rays(count: int) -> Rays:
    directions = torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)
    sizes = torch.full((count,), 0.01)
    origins = torch.zeros(count, 3).requires_grad_()
    return Rays(origins, directions, torch.full((count,), 0.1), torch.full((count,), 4.0), sizes, torch.rand(count))


@pytest.mark.parametrize("footprint", ["frustum", "gaussian", "radius"])
def test_a_density_gets_the_footprint_that_it_asks_for(footprint: str) -> None:
    """The frustums are the intervals of its weights, with their times, and without a gradient to the rays."""
    plain, sized = Fog("none"), Fog(footprint)
    samples = propose(
        rays(5), [plain.density, sized.density], (8, 6, 4), 1.0, jitter=False, power=1.0, learning=True,
        footprints=[plain.footprint, sized.footprint],
    )  # fmt: skip
    assert (plain.seen[0].radii, plain.seen[0].frustums) == (None, None)
    points = sized.seen[0]
    assert len(points) == 30
    assert points.radii is not None
    assert points.times is not None
    assert not points.positions.requires_grad
    assert (points.frustums is not None) == (footprint == "frustum")
    assert (points.covariances is not None) == (footprint == "gaussian")
    if points.frustums is not None:
        t = spacing(torch.full((5,), 0.1), torch.full((5,), 4.0), 1.0)(samples.proposals[1].edges)
        torch.testing.assert_close(points.frustums.t_starts, t[:, :-1].flatten())
        torch.testing.assert_close(points.frustums.t_ends, t[:, 1:].flatten())
        assert points.frustums.ranks is not None
        assert points.frustums.ranks.tolist() == [0, 1, 2, 3, 4, 5] * 5


def test_the_blurred_loss_is_the_mean_over_rays_of_all_proposals() -> None:
    torch.manual_seed(0)
    edges = torch.rand(3, 5).sort(-1).values
    weights = torch.rand(3, 4) / 4
    proposals = tuple(Histogram(torch.rand(3, n + 1).sort(-1).values, torch.rand(3, n) / 9) for n in (6, 7))
    samples = Samples.regular(edges[:, :-1], edges[:, 1:])
    samples = Samples(**{**vars(samples), "edges": edges, "proposals": proposals})
    truth = sum(
        blurred_excess_reference(edges, weights, p.edges, p.weights, blur).mean()
        for p, blur in zip(proposals, (0.03, 0.003), strict=True)
    )
    assert interlevel_loss(samples, weights.flatten(), (0.03, 0.003)).item() == pytest.approx(truth.item(), rel=1e-4)
    assert interlevel_loss(samples, weights.flatten()).item() != pytest.approx(truth.item(), rel=1e-2)


def test_one_blur_for_each_proposal_is_needed() -> None:
    fields = [Fog("none"), Fog("none")]
    sampler = ProposalSampler(BOX, (8, 6, 4), fields=fields, ladder=-1.5, blurs=(0.1, 0.2))
    assert (sampler.ladder, sampler.blurs) == (-1.5, (0.1, 0.2))
    with pytest.raises(ValueError, match="1 blurs for 2 proposals"):
        ProposalSampler(BOX, (8, 6, 4), fields=fields, blurs=(0.1,))


def test_frustums_end_before_an_endless_interval_does() -> None:
    """They are evaluated where the ray's far end is, since at infinity they would have no place."""
    field = Fog("frustum")
    sampler = ProposalSampler(BOX, (8, 6, 4), fields=[Fog("none"), Fog("none")], unbounded=True, endless=True)
    samples = sampler.sample(rays(5), field, jitter=False)
    assert samples.sigma is not None
    assert samples.padded(samples.t_ends)[:, -1].tolist() == [1e10] * 5
    (points,) = field.seen
    assert points.frustums is not None
    assert points.frustums.t_ends.max().item() <= 4.001

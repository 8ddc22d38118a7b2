"""A proposal's weights in one call, against single operations and float64: values and gradients."""

import pytest
import torch
from torch import Tensor

from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.fields.base import MLP
from nerfloom.fields.encoded import DensityField
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.histograms.intervals import interval_weights_reference
from nerfloom.kernels.histograms.proposals import PROPOSAL_WEIGHTS, proposal_weights, proposal_weights_reference
from nerfloom.samplers.proposal import ProposalSampler, density_of
from tests.kernels.compiled import needs_kernels
from tests.kernels.test_trace import BOX, rays

BINS = 37  # neither a number of lanes nor a divisor of a block


def field(unbounded: bool, sparse: bool, features: int = 2) -> DensityField:
    torch.manual_seed(3)
    made = DensityField(BOX, HashGrid(5, features, 4, 64, 10, sparse), unbounded=unbounded)
    with torch.no_grad():
        made.encoding.table.uniform_(-1, 1)
    return made


def distances(count: int) -> Tensor:
    return (torch.rand(count, BINS + 1) * 12).sort(-1).values


def gradients(of: DensityField, weights: Tensor, factors: Tensor) -> list[Tensor]:
    (weights * factors).sum().backward()
    table, deferred = of.encoding.table, of.encoding.deferred
    own = torch.zeros_like(table) if table.grad is None else table.grad
    if deferred is not None and deferred.pending:
        deferred.add_to(own)
    return [own, *(weight.grad for weight in of.head.parameters())]


@needs_kernels
@pytest.mark.parametrize("bfloat16", [False, True])
@pytest.mark.parametrize(
    ("count", "unbounded", "sparse", "features"), [(300, False, True, 2), (300, True, False, 4), (1, True, True, 1)]
)
def test_weights_and_gradients_are_those_of_single_operations(
    count: int, unbounded: bool, sparse: bool, features: int, bfloat16: bool
) -> None:
    torch.manual_seed(0)
    lines, t, factors = rays(count), distances(count), torch.randn(count, BINS)
    found = []
    for run in (PROPOSAL_WEIGHTS.implementations[0].run, proposal_weights_reference):
        of = field(unbounded, sparse, features)
        density = of.grid_density()
        assert density is not None
        with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
            with torch.no_grad():
                alone = run(lines, t, density)
            weights = run(lines, t, density)
        torch.testing.assert_close(alone, weights.detach(), rtol=1e-5, atol=1e-6)
        found.append((weights.detach(), gradients(of, weights, factors)))
    (ours, own), (theirs, expected) = found
    assert float((ours - theirs).norm()) <= (1e-2 if bfloat16 else 1e-4) * float(theirs.norm())
    assert float(theirs.sum()) > 0.5 * count  # the rays meet something
    for one, other in zip(own, expected, strict=True):
        assert float((one - other).norm()) <= (2e-2 if bfloat16 else 1e-3) * float(other.norm())


@needs_kernels
@pytest.mark.parametrize("unbounded", [False, True])
def test_weights_and_gradients_are_those_of_float64(unbounded: bool) -> None:
    torch.manual_seed(0)
    lines, t, factors = rays(200), distances(200), torch.randn(200, BINS)
    of, exact = field(unbounded, False), field(unbounded, False).double()
    density = density_of(of)
    assert not callable(density)
    weights = proposal_weights(lines, t, density)
    own = gradients(of, weights, factors)
    middles = (t[:, 1:] + t[:, :-1]).double() / 2
    positions = lines.origins.double()[:, None] + lines.directions.double()[:, None] * middles[..., None]
    sigma, _ = exact.density(Points(positions.flatten(0, 1)))
    truth = interval_weights_reference(sigma.view(middles.shape), t.double())
    torch.testing.assert_close(weights.double(), truth, rtol=1e-3, atol=1e-4)
    for ours, theirs in zip(own, gradients(exact, truth, factors.double()), strict=True):
        assert float((ours.double() - theirs).norm()) <= 1e-3 * float(theirs.norm())


@needs_kernels
def test_damage_stays_on_its_rays_and_no_rays_have_no_weights() -> None:
    torch.manual_seed(0)
    of, lines, t = field(True, True), rays(50), distances(50)
    density = of.grid_density()
    assert density is not None
    with torch.no_grad():
        before = proposal_weights(lines, t, density)
        lines.origins[7] = torch.nan
        after = proposal_weights(lines, t, density)
        assert bool(after[7].isnan().any())
        others = torch.arange(50) != 7
        assert torch.equal(before[others], after[others])
        assert proposal_weights(lines[:0], t[:0], density).shape == (0, BINS)
    assert proposal_weights(lines[:0], t[:0], density).shape == (0, BINS)


def test_a_network_with_biases_or_an_activation_is_asked_itself() -> None:
    for network in (MLP(10, 16, 1), MLP(10, 16, 1, bias=False, activation="relu")):
        of = field(False, False)
        assert of.grid_density() is not None
        of.head = network
        assert of.grid_density() is None
        assert density_of(of) == of.density


def test_no_gradient_goes_to_rays() -> None:
    of, lines, t = field(False, False), rays(20), distances(20)
    lines.directions.requires_grad_()
    density = of.grid_density()
    assert density is not None
    proposal_weights(lines, t, density).sum().backward()
    assert lines.directions.grad is None
    assert of.encoding.table.grad is not None


def test_a_sampler_draws_as_from_the_density_alone() -> None:
    class Unknown(DensityField):
        def grid_density(self) -> None:
            return None

    found = []
    for kind in (DensityField, Unknown):
        torch.manual_seed(3)
        fields = [kind(BOX, HashGrid(5, 2, 4, 64, 10), unbounded=True) for _ in range(2)]
        sampler = ProposalSampler(BOX, (16, 8, 4), unbounded=True, fields=fields).train()
        sampler.update(0, fields[0].density)
        torch.manual_seed(5)
        lines = rays(40)
        samples = sampler.sample(Rays(lines.origins, lines.directions, fars=torch.full((40,), 9.0)), fields[0], True)
        found.append((samples.t_starts, *(p.weights.detach() for p in samples.proposals)))
    assert len(found[0]) == 3
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=2e-3, atol=2e-4)

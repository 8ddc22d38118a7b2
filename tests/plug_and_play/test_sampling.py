"""Sampling as functions: even bins, the inverse CDF, proposals; against closed forms."""

import math

import pytest
import torch
from torch import Tensor, nn

import nerfloom
from benchmarks.closed_forms import BOX, Ball, ClosedForm, Medium, Solids, scenes
from benchmarks.sampling import random_rays
from nerfloom.geometry.rays import Samples
from tests.plug_and_play.scenes import BACKGROUND, functions


def error(rays: nerfloom.Rays, samples: Samples, scene: str | ClosedForm) -> float:
    """Root mean square error of colour."""
    field = scenes()[scene] if isinstance(scene, str) else scene
    color = nerfloom.render(rays, samples, functions(field)[1], BACKGROUND).rgb
    return (color.double() - field.truth(rays, BACKGROUND).color).square().mean().sqrt().item()


def test_a_ray_is_clipped_to_a_box() -> None:
    origins = torch.tensor([[-3.0, 0, 0], [-3.0, 0, 0], [0.5, 0, 0], [-3.0, 5, 0], [-3.0, 0, 0]])
    rays = nerfloom.Rays(
        origins,
        torch.tensor([[1.0, 0, 0]]).expand(5, 3),
        torch.tensor([0.0, 2.5, 0, 0, 0]),
        torch.tensor([math.inf, 3.5, math.inf, math.inf, 1]),
    )
    found = nerfloom.clip_to_box(rays, [[-1, -1, -1], [1, 1, 1]])
    assert found.nears.tolist() == [2, 2.5, 0, 0, 2]
    assert found.fars.tolist() == [4, 3.5, 0.5, 0, 2]
    assert len(found[:2]) == 2


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_even_samples_are_evenly_spread(dtype: torch.dtype) -> None:
    rays = nerfloom.Rays(
        torch.zeros(1000, 3, dtype=dtype),
        torch.tensor([[0.0, 0, 1]], dtype=dtype).expand(1000, 3),
        torch.full((1000,), 2.0, dtype=dtype),
        torch.full((1000,), 6.0, dtype=dtype),
    )
    torch.testing.assert_close(
        nerfloom.sample_uniform(rays, 4).padded(nerfloom.sample_uniform(rays, 4).t)[0],
        torch.tensor([2.5, 3.5, 4.5, 5.5], dtype=dtype),
    )
    samples = nerfloom.sample_uniform(rays, 4, jitter=True)
    t = samples.padded(samples.t)
    assert bool((t >= samples.padded(samples.t_starts)).all())
    assert bool((t <= samples.padded(samples.t_ends)).all())
    torch.testing.assert_close(t.mean(0), torch.tensor([2.5, 3.5, 4.5, 5.5], dtype=dtype), rtol=0, atol=0.05)
    torch.testing.assert_close(t.std(0), torch.full((4,), 12**-0.5, dtype=dtype), rtol=0, atol=0.03)


@pytest.mark.parametrize("jitter", [False, True])
def test_samples_by_the_inverse_cdf_go_where_the_weights_are(jitter: bool) -> None:
    """NeRF's second pass: of its samples a larger share lies in matter, and there are fewer errors than before it."""
    torch.manual_seed(0)
    rays = random_rays(500, seed=0)
    even = nerfloom.sample_uniform(rays, 32, jitter=jitter)
    weights = nerfloom.render(rays, even, functions("nested")[1], BACKGROUND).weights
    fine = nerfloom.sample_inverse_cdf(rays, even, weights, 64, jitter=jitter)
    assert fine.per_ray == 96
    t = fine.padded(fine.t)
    assert bool((t.diff(dim=-1) >= 0).all())
    starts, ends = fine.padded(fine.t_starts), fine.padded(fine.t_ends)
    assert torch.equal(starts[:, 1:], ends[:, :-1])
    assert bool((starts <= t).all())
    assert bool((t <= ends).all())
    assert torch.equal(starts[:, 0], rays.nears)
    assert torch.equal(ends[:, -1], rays.fars)
    assert bool(torch.isin(even.t, fine.t).all())
    shares = [(functions("nested")[0](samples.positions(rays)) > 0).float().mean() for samples in (even, fine)]
    assert shares[1] > 1.5 * shares[0]
    errors = error(rays, even, "nested"), error(rays, fine, "nested")
    print(f"jitter {jitter}: {errors[0]:.1e} evenly, {errors[1]:.1e} with twice as many by the inverse CDF")
    assert errors[1] < errors[0] / 2


class Proposal(nn.Module):
    """A density of one's own: a small network."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(3, 32), nn.ReLU(), nn.Linear(32, 32), nn.ReLU(), nn.Linear(32, 1))

    def forward(self, positions: Tensor) -> Tensor:
        return nn.functional.softplus(self.layers(2 * positions))[:, 0]


@pytest.mark.medium
def test_proposals_learn_where_light_is_stopped() -> None:
    """Ordinary functions, in an ordinary loop: eight samples a ray find a ball."""
    torch.manual_seed(0)
    scene = Solids(Medium(Ball(0.3, (0.2, 0.1, 0.0)), 40.0, (0.5, 0.5, 0.5), (0.8, 0.8, 0.8)))
    counts, rgb_sigma_fn = (48, 32, 8), functions(scene)[1]
    proposals = [Proposal(), Proposal()]
    optimizer = torch.optim.Adam([p for proposal in proposals for p in proposal.parameters()], lr=3e-3)
    judged = nerfloom.clip_to_box(random_rays(500, seed=1), BOX)
    losses, errors = [], []
    for step in range(151):
        if step in (0, 150):
            with torch.no_grad():
                samples = nerfloom.sample_proposals(judged, proposals, counts)
            assert samples.proposals == ()
            errors.append(error(judged, samples, scene))
        rays = nerfloom.clip_to_box(random_rays(256, seed=step + 2), BOX)
        samples = nerfloom.sample_proposals(rays, proposals, counts, jitter=True, power=min(1.0, step / 75))
        assert not samples.t_starts.requires_grad
        loss = nerfloom.interlevel_loss(samples, nerfloom.render(rays, samples, rgb_sigma_fn, BACKGROUND).weights)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    print(f"proposals: loss {losses[0]:.4f} to {losses[-1]:.4f}, colour off by {errors[0]:.1e} to {errors[1]:.1e}")
    assert sum(losses[-10:]) < 0.7 * sum(losses[:10])
    assert errors[1] < errors[0] / 4


def test_proposals_of_a_scene_without_end() -> None:
    """Even up to `scale`, in disparity beyond, to wherever a ray ends; contraction takes it all into a cube."""
    rays = nerfloom.Rays(torch.zeros(3, 3), torch.eye(3), torch.full((3,), 0.1))
    samples = nerfloom.sample_proposals(rays, [lambda x: torch.zeros_like(x[:, 0])], (64, 32), scale=1.0)
    t = samples.padded(samples.t)
    assert bool(t.isfinite().all())
    assert bool((t.diff(dim=-1) > 0).all())
    assert t[0, 0] < 0.2
    assert t[0, -1] > 20
    assert 10 <= (t[0] < 1).sum() <= 16
    unit = nerfloom.contract_to_unit(samples.positions(rays), BOX)
    assert unit.min() >= 0
    assert unit.max() <= 1
    torch.testing.assert_close(nerfloom.contract(torch.tensor([[4.0, 0, 0]])), torch.tensor([[1.75, 0, 0]]))


def test_proposals_see_the_time_of_their_ray() -> None:
    rays = nerfloom.Rays(torch.zeros(2, 3), torch.eye(3)[:2], fars=torch.ones(2), times=torch.tensor([0.25, 0.75]))
    asked = []

    def sigma_fn(positions: Tensor, times: Tensor) -> Tensor:
        asked.append((positions, times))
        return times

    nerfloom.sample_proposals(rays, [sigma_fn], (5, 3))
    (positions, times) = asked[0]
    assert times.tolist() == [0.25] * 5 + [0.75] * 5
    assert bool((positions[:5, 0] > 0).all())
    assert bool((positions[5:, 1] > 0).all())


def test_what_is_wrong_is_said() -> None:
    rays = nerfloom.Rays(torch.zeros(2, 3), torch.eye(3)[:2])
    with pytest.raises(ValueError, match="give Rays its fars"):
        nerfloom.sample_uniform(rays, 4)
    with pytest.raises(ValueError, match="give Rays its fars"):
        nerfloom.sample_proposals(rays, [lambda x: x[:, 0]], (4, 2))
    with pytest.raises(ValueError, match="2 counts for 2 proposals"):
        nerfloom.sample_proposals(rays, [lambda x: x[:, 0]] * 2, (4, 2), scale=1.0)
    with pytest.raises(ValueError, match="sigma_fn returned density of shape"):
        nerfloom.sample_proposals(rays, [lambda x: x], (4, 2), scale=1.0)
    packed = Samples(torch.zeros(3), torch.ones(3), torch.tensor([0, 1, 3]))
    with pytest.raises(ValueError, match="same number of samples"):
        nerfloom.sample_inverse_cdf(nerfloom.clip_to_box(rays, BOX), packed, torch.ones(3), 4)

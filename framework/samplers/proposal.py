"""Samples where small density fields propose them: mip-NeRF 360 (Barron et al. 2022), section 3.

A proposal looks at many intervals of a ray cheaply, and the next level's intervals are drawn by the light that it
believes them to stop. What the last level finds teaches the proposals to bound it from above (`interlevel_loss`).
Distance is normalised: s in [0, 1] from a ray's near to its far end, evenly up to half of the box's edge and in
disparity beyond for an unbounded scene, evenly throughout for a bounded one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import torch
from torch import Tensor, nn

from framework.base.optimised import Optimised
from framework.encodings.hash_grid import HashGrid
from framework.fields.base import DensityFunction, Field
from framework.fields.encoded import DensityField
from framework.geometry.bounds import intersect_box
from framework.geometry.points import Points
from framework.geometry.rays import Histogram, Rays, Samples
from framework.kernels.intervals import interval_weights, proposal_excess, resample
from framework.samplers.base import Sampler

ANNEALING_SLOPE = 10.0
"""b of the annealing of weights: u^(b x / ((b - 1) x + 1)) with x the share of `anneal_steps` done."""
PADDING = 0.01
"""Added to all weights of a ray together, so that no place is never looked at."""
ALWAYS_LEARN_UNTIL, LEARN_EVERY = 256, 4
"""Steps after which proposals, which change little by then, learn only in one of so many."""
FARTHEST = 1e10
"""Where an endless ray's last interval ends."""


class ProposalSampler(Sampler):
    """Two or more levels of proposals, the last of which places the samples.

    Args:
        box: (2, 3) the scene.
        counts: intervals of each proposal, then samples.
        resolutions: cells along an axis at the finest level of each proposal's hash grid.
        unbounded: the scene goes on outside the box.
        endless: the last interval has no end, so that a ray always ends in matter: for photographs without alpha.
        log2_table_size, num_levels: of the proposals' hash grids.
        anneal_steps: over which the proposals come to be believed.
    """

    box: Tensor
    optimised = Optimised("proposals", learning_rate=1e-2, betas=(0.9, 0.99), eps=1e-15)

    def __init__(
        self,
        box: Tensor,
        counts: tuple[int, ...] = (128, 64, 32),
        resolutions: tuple[int, ...] = (128, 256),
        unbounded: bool = False,
        endless: bool = False,
        log2_table_size: int = 16,
        num_levels: int = 5,
        anneal_steps: int = 1000,
    ) -> None:
        super().__init__()
        if len(counts) != len(resolutions) + 1:
            raise ValueError(f"{len(counts)} counts for {len(resolutions)} proposals: one more is needed")
        self.endless = endless
        self.counts, self.unbounded, self.anneal_steps = counts, unbounded, anneal_steps
        self.scale = half_edge(box)
        self.register_buffer("box", box.clone())
        grids = [HashGrid(num_levels, 2, 16, finest, log2_table_size) for finest in resolutions]
        self.fields = nn.ModuleList(DensityField(box, grid, unbounded=unbounded) for grid in grids)
        self.power = 1.0
        self.learning = False

    @property
    def proposals(self) -> list[Field]:
        """The density fields, in the order in which they are asked."""
        return [field for field in self.fields if isinstance(field, Field)]

    def sample(self, rays: Rays, field: Field, jitter: bool) -> Samples:
        """The last level's samples; with a gradient for the proposals in the steps in which they learn."""
        learning = self.learning and self.training and torch.is_grad_enabled()
        nears, fars = self._ends(rays)
        return propose(
            replace(rays, nears=nears, fars=fars),
            [proposal.density for proposal in self.proposals],
            self.counts,
            self.scale if self.unbounded else None,
            jitter=jitter,
            power=self.power if self.training else 1.0,
            learning=learning,
            endless=self.endless,
        )

    def update(self, step: int, density: DensityFunction) -> None:
        """How far the proposals are believed in this step, and whether they learn."""
        x = min(step / max(self.anneal_steps, 1), 1.0)
        self.power = ANNEALING_SLOPE * x / ((ANNEALING_SLOPE - 1) * x + 1)
        self.learning = step < ALWAYS_LEARN_UNTIL or step % LEARN_EVERY == 0

    def losses(self, samples: Samples, weights: Tensor) -> dict[str, Tensor]:
        return {"interlevel": interlevel_loss(samples, weights)} if samples.proposals else {}

    def _ends(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """Where sampling starts and ends on each ray."""
        if self.unbounded:
            return rays.nears, rays.fars
        enter, leave = intersect_box(rays.origins.detach(), rays.directions.detach(), self.box)
        near = torch.minimum(torch.maximum(enter, rays.nears), leave)
        return near, torch.maximum(torch.minimum(leave, rays.fars), near)


def propose(
    rays: Rays,
    densities: Sequence[DensityFunction],
    counts: Sequence[int],
    scale: float | None,
    *,
    jitter: bool,
    power: float,
    learning: bool,
    endless: bool,
) -> Samples:
    """Draw samples in levels, each by the densities of the one before, and return those of the last.

    Args:
        rays: R rays, sampled from near to far.
        densities: of each level but the last.
        counts: intervals of each level, then samples: one more than there are densities.
        scale: see `distances`.
        jitter: random positions, or fixed ones.
        power: which weights are raised to before they are drawn by: less than 1 flattens them.
        learning: keep what the densities found, gradients attached, in `Samples.proposals`.
        endless: the last interval has no end.
    """
    nears, fars = rays.nears, rays.fars
    count, device = len(rays), nears.device
    edges = torch.linspace(0, 1, counts[0] + 1, device=device, dtype=nears.dtype).expand(count, -1)
    if jitter:  # the inner edges move together by up to half an interval either way
        moved = edges + (torch.rand(count, 1, device=device) - 0.5) / counts[0]
        edges = torch.cat([edges[:, :1], moved[:, 1:-1], edges[:, -1:]], dim=-1)
    proposals: list[Histogram] = []
    for (here, following), density in zip(pairwise(counts), densities, strict=True):
        t = distances(edges, nears, fars, scale)
        middles = (t[:, 1:] + t[:, :-1]) / 2
        with torch.set_grad_enabled(learning):
            positions = _positions(rays, middles)
            when = None if rays.times is None else rays.times.repeat_interleave(here)
            sigma, _ = density(Points(positions, when))
            weights = interval_weights(sigma.view(middles.shape), t)
        proposals.append(Histogram(edges, weights))
        shift = torch.rand(count, device=device) if jitter else torch.full((count,), 0.5, device=device)
        edges = resample(edges, weights.detach(), shift, following, power, PADDING / here)
    t = distances(edges, nears, fars, scale)
    ends = t[:, 1:]
    if endless:
        ends = torch.cat([ends[:, :-1], torch.full_like(ends[:, :1], FARTHEST)], dim=-1)
    return replace(
        Samples.regular(t[:, :-1], ends, (t[:, 1:] + t[:, :-1]) / 2),
        owners=torch.arange(count, device=device).repeat_interleave(counts[-1]),
        edges=edges,
        proposals=tuple(proposals) if learning else (),
    )


def distances(edges: Tensor, nears: Tensor, fars: Tensor, scale: float | None) -> Tensor:
    """Convert normalised distances (R, B) to distances along rays (R, B).

    Args:
        edges: (R, B) in [0, 1].
        nears, fars: (R,) the rays' ends, where edges of 0 and 1 lie.
        scale: the distance up to which they are even, being in disparity beyond; None for even ones throughout.
    """
    if scale is None:
        return torch.lerp(nears[:, None], fars[:, None], edges)
    near, far = (to_disparity(t / scale)[:, None] for t in (nears, fars))
    return scale * from_disparity(torch.lerp(near, far, edges))


def half_edge(box: Tensor) -> float:
    """Half of the edge of the cube that is as large as `box` (2, 3): the unit of an unbounded scene's distances."""
    return math.prod((box[1] - box[0]).tolist()) ** (1 / 3) / 2


def to_disparity(t: Tensor) -> Tensor:
    """Distances from 0 to infinity to [0, 1): t / 2 up to t = 1, then 1 - 1 / (2 t)."""
    return torch.where(t < 1, t / 2, 1 - 1 / (2 * t.clamp(min=1)))


def from_disparity(s: Tensor) -> Tensor:
    """The inverse of `to_disparity`; finite at 1."""
    tiny = torch.finfo(s.dtype).eps
    return torch.where(s < 0.5, 2 * s, 1 / (2 - 2 * s).clamp(min=tiny))


def interlevel_loss(samples: Samples, weights: Tensor) -> Tensor:
    """How much the proposals fell short of the weights (N,) found by the last level, a mean over rays.

    mip-NeRF 360, equation 13. 0 where no proposal is learning.
    """
    if samples.edges is None or not samples.proposals or samples.num_rays == 0:
        return weights.new_zeros(())
    found = samples.padded(weights.detach())
    losses = [proposal_excess(samples.edges, found, p.edges, p.weights).mean() for p in samples.proposals]
    return torch.stack(losses).sum()


def _positions(rays: Rays, t: Tensor) -> Tensor:
    """(R * B, 3) at distances t (R, B); without a gradient for the rays."""
    origins, directions = rays.origins.detach(), rays.directions.detach()
    return torch.addcmul(origins[:, None], directions[:, None], t[..., None]).view(-1, 3)

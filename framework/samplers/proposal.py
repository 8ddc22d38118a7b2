"""Sampling with proposals, which are small density fields: mip-NeRF 360 (Barron et al. 2022), section 3.

Proposals are cheap to evaluate in many intervals of a ray. Intervals of the next level are drawn from their weights.
The proposals are trained so that their weights bound the last level's weights from above (`interlevel_loss`).

Intervals are drawn in normalised distance s in [0, 1], from the near to the far end of a ray. In a bounded scene s is
linear in the distance. In an unbounded scene it is linear up to half the edge of the box and linear in disparity
beyond, or it follows Zip-NeRF's power ladder.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import torch
from torch import Tensor, nn

from nerfloom.base.device import StepValue
from nerfloom.base.optimised import Optimised
from nerfloom.base.step_kind import StepKind
from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.fields.base import DensityFunction, Field, HasGridDensity
from nerfloom.fields.encoded import DensityField
from nerfloom.geometry.bounds import half_edge, intersect_box
from nerfloom.geometry.points import Footprint, Points, sample_points
from nerfloom.geometry.rays import Histogram, Rays, Samples
from nerfloom.kernels.histograms.intervals import interval_weights, proposal_excess, resample
from nerfloom.kernels.histograms.proposals import proposal_weights
from nerfloom.kernels.histograms.spacing import spacing
from nerfloom.kernels.histograms.step_functions import blurred_excess
from nerfloom.kernels.traced.trace import GridDensity
from nerfloom.samplers.base import Sampler

ANNEALING_SLOPE = 10.0
"""Parameter b of the annealing of weights w^(b x / ((b - 1) x + 1)), where x is the fraction of `anneal_steps` done."""
PADDING = 0.01
"""Sum of the padding added to the weights of a ray, so that every interval can be drawn."""
ALWAYS_LEARN_UNTIL, LEARN_EVERY = 256, 4
"""Number of first steps that all train the proposals, and the number of steps between updates afterwards."""
ENDLESS_FAR = 1e10
"""Far end of the last interval of an endless ray, scene units."""


class ProposalSampler(Sampler):
    """Samples drawn in levels, from the weights of one or more proposals.

    Args:
        box: (2, 3) corners of the box that holds the scene, scene units.
        counts: intervals per ray of each proposal, followed by the number of samples per ray.
        resolutions: cells along an axis at the finest level of each proposal's hash grid.
        unbounded: whether the scene extends beyond the box.
        endless: whether the last interval ends at `ENDLESS_FAR`, so that any density there makes the ray opaque. For
            images without an alpha channel.
        log2_table_size: maximum number of entries per level of the proposals' hash grids, as a power of two.
        num_levels: levels of the proposals' hash grids.
        anneal_steps: training steps over which the weights are annealed.
        fields: other density fields instead of hash grids; the last field is also used for all further levels.
        learn_every: number of steps between updates of the proposals, after the first `ALWAYS_LEARN_UNTIL`.
        ladder: exponent of the power ladder that spaces distances of an unbounded scene; None for disparity.
        blurs: for each proposal, the radius in normalised distance of the box filter on the samples' histogram in
            Zip-NeRF's loss; empty for the loss of mip-NeRF 360.

    Raises:
        ValueError: unless there is one count more than resolutions, at most one field per proposal, and one blur per
            proposal (or none).
    """

    box: Tensor
    learns_from_weights = True
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
        fields: Sequence[Field] | None = None,
        learn_every: int = LEARN_EVERY,
        ladder: float | None = None,
        blurs: tuple[float, ...] = (),
    ) -> None:
        super().__init__()
        if fields is None and len(counts) != len(resolutions) + 1:
            raise ValueError(f"{len(counts)} counts for {len(resolutions)} proposals: give one more")
        if fields is not None and not 1 <= len(fields) < len(counts):
            raise ValueError(f"{len(fields)} density fields for {len(counts) - 1} proposals")
        if blurs and len(blurs) != len(counts) - 1:
            raise ValueError(f"{len(blurs)} blurs for {len(counts) - 1} proposals: one for each is needed")
        self.endless, self.learn_every = endless, learn_every
        self.counts, self.unbounded, self.anneal_steps = counts, unbounded, anneal_steps
        self.scale = half_edge(box)
        self.ladder, self.blurs = ladder, blurs
        self.register_buffer("box", box.clone())
        if fields is None:
            grids = [HashGrid(num_levels, 2, 16, finest, log2_table_size) for finest in resolutions]
            fields = [DensityField(box, grid, unbounded=unbounded) for grid in grids]
        self.fields = nn.ModuleList(fields)
        self.power = StepValue(1.0)
        self.learning = False

    @property
    def proposals(self) -> list[Field]:
        """The density fields, in the order of evaluation."""
        fields = [field for field in self.fields if isinstance(field, Field)]
        return fields + fields[-1:] * (len(self.counts) - 1 - len(fields))

    def sample(self, rays: Rays, field: Field, jitter: bool) -> Samples:
        """Return the samples of the last level. While proposals learn, their gradients are attached."""
        learning = self.learning and self.training and torch.is_grad_enabled()
        nears, fars = self._ends(rays)
        samples = propose(
            replace(rays, nears=nears, fars=fars),
            [density_of(proposal) for proposal in self.proposals],
            self.counts,
            self.scale if self.unbounded else None,
            jitter=jitter,
            power=self.power.on(nears.device) if self.training else 1.0,
            learning=learning,
            ladder=self.ladder,
            footprints=[proposal.footprint for proposal in self.proposals],
        )
        if not self.endless:
            return samples
        if field.footprint in ("gaussian", "frustum"):  # before the last interval becomes endless
            samples = samples.evaluated(*field.density(sample_points(rays, samples, field.footprint)))
        ends = samples.padded(samples.t_ends).clone()
        ends[:, -1] = ENDLESS_FAR
        return replace(samples, t_ends=ends.view(-1))

    def update(self, step: int, density: DensityFunction) -> None:
        """Set the exponent of the annealing, and whether the proposals learn in this step."""
        x = min(step / max(self.anneal_steps, 1), 1.0)
        self.power.set(ANNEALING_SLOPE * x / ((ANNEALING_SLOPE - 1) * x + 1))
        self.learning = self.learns(step)

    def learns(self, step: int) -> bool:
        """Return whether the proposals learn in training step number `step`, counted from 0."""
        return step < ALWAYS_LEARN_UNTIL or step % self.learn_every == 0

    def step_kind(self, step: int) -> StepKind:
        return StepKind((self.learns(step),))

    def loss(self, samples: Samples, weights: Tensor) -> Tensor | None:
        return interlevel_loss(samples, weights, self.blurs) if samples.proposals else None

    def _ends(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """Return the distances (R,) where sampling starts and ends; in a bounded scene, within the box."""
        if self.unbounded:
            return rays.nears, rays.fars
        enter, leave = intersect_box(rays.origins.detach(), rays.directions.detach(), self.box)
        near = torch.minimum(torch.maximum(enter, rays.nears), leave)
        return near, torch.maximum(torch.minimum(leave, rays.fars), near)


def propose(
    rays: Rays,
    densities: Sequence[DensityFunction | GridDensity],
    counts: Sequence[int],
    scale: float | None,
    *,
    jitter: bool,
    power: float | Tensor,
    learning: bool,
    ladder: float | None = None,
    footprints: Sequence[Footprint] | None = None,
) -> Samples:
    """Return samples drawn in levels, each from the weights of the level before.

    Args:
        rays: R rays, sampled from the near to the far end.
        densities: density of each proposal level.
        counts: intervals per ray of each level, followed by the number of samples per ray: one more than densities.
        scale: distance up to which normalised distance is linear, or the unit of the ladder, as in `spacing`.
        jitter: True for random positions, False for fixed ones.
        power: exponent of the weights before drawing, as in `resample`; less than 1 flattens them.
        learning: whether to keep the proposals' weights, gradients attached, in `Samples.proposals`.
        ladder: exponent of the power ladder, as in `spacing`.
        footprints: size of points that each density needs; none if empty.
    """
    nears, fars = rays.nears, rays.fars
    count, device = len(rays), nears.device
    edges = torch.linspace(0, 1, counts[0] + 1, device=device, dtype=nears.dtype).expand(count, -1)
    if jitter:  # the inner edges move together by up to half an interval either way
        moved = edges + (torch.rand(count, 1, device=device) - 0.5) / counts[0]
        edges = torch.cat([edges[:, :1], moved[:, 1:-1], edges[:, -1:]], dim=-1)
    histograms: list[Histogram] = []
    placed = spacing(nears, fars, scale, ladder)
    kinds = footprints or ["none"] * len(densities)
    for (num_intervals, num_next), density, kind in zip(pairwise(counts), densities, kinds, strict=True):
        t = placed(edges)
        with torch.set_grad_enabled(learning):
            if isinstance(density, GridDensity):
                weights = proposal_weights(rays, t, density)
            else:
                sigma, _ = density(_points(rays, t, kind))
                weights = interval_weights(sigma.view(count, num_intervals), t)
        histograms.append(Histogram(edges, weights))
        shift = torch.rand(count, device=device) if jitter else torch.full((count,), 0.5, device=device)
        edges = resample(edges, weights.detach(), shift, num_next, power, PADDING / num_intervals)
    t = placed(edges)
    return replace(
        Samples.regular(t[:, :-1], t[:, 1:], (t[:, 1:] + t[:, :-1]) / 2),
        owners=torch.arange(count, device=device).repeat_interleave(counts[-1]),
        edges=edges,
        proposals=tuple(histograms) if learning else (),
    )


def density_of(proposal: Field) -> DensityFunction | GridDensity:
    """Return the density of a field `proposal`; in the kernels' form if it is a small network on a hash grid."""
    known = proposal.grid_density() if isinstance(proposal, HasGridDensity) else None
    return proposal.density if known is None else known


def interlevel_loss(samples: Samples, weights: Tensor, blurs: Sequence[float] = ()) -> Tensor:
    """Return the loss () of the proposals; their weights should bound the last level's weights from above.

    mip-NeRF 360, equation 13, or Zip-NeRF's anti-aliased loss: the mean over rays, summed over proposals. It is 0 if
    the proposals are not learning.

    Args:
        samples: N samples of a `ProposalSampler`.
        weights: (N,) rendering weights of the samples; without a gradient.
        blurs: radius of the box for each proposal, for the anti-aliased loss; empty for the loss of mip-NeRF 360.
    """
    if samples.edges is None or not samples.proposals or samples.num_rays == 0:
        return weights.new_zeros(())
    rendered = samples.padded(weights.detach())
    edges = samples.edges
    if blurs:
        pairs = zip(samples.proposals, blurs, strict=True)
        losses = [blurred_excess(edges, rendered, p.edges, p.weights, blur).mean() for p, blur in pairs]
    else:
        losses = [proposal_excess(edges, rendered, p.edges, p.weights).mean() for p in samples.proposals]
    return torch.stack(losses).sum()


def _points(rays: Rays, t: Tensor, footprint: Footprint) -> Points:
    """Return the points of intervals with edges `t` (R, B + 1), with a footprint; rays get no gradient."""
    origins, directions = rays.origins.detach(), rays.directions.detach()
    if footprint != "none":
        detached = replace(rays, origins=origins, directions=directions)
        return sample_points(detached, Samples.regular(t[:, :-1], t[:, 1:]), footprint)
    middles = (t[:, 1:] + t[:, :-1]) / 2
    positions = torch.addcmul(origins[:, None], directions[:, None], middles[..., None]).view(-1, 3)
    times = None if rays.times is None else rays.times.repeat_interleave(middles.shape[1])
    return Points(positions, times)

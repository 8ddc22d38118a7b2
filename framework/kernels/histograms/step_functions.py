"""Blurred step functions, and the anti-aliased loss of proposals: Zip-NeRF (Barron et al. 2023), on z-aliasing.

A histogram along a ray is a step function. The loss of mip-NeRF 360 jumps when an edge of one histogram passes an edge
of the other, so that proposals learn where edges are, and lose thin structures as the camera moves. Zip-NeRF first
blurs the finer histogram with a box, which makes it piecewise linear, and then compares the weight in each proposed
bin.

The paper sorts the edges of the blurred function. Here nothing is sorted. With D the second integral of the step
function, which is quadratic between its edges, the integral of the blurred function up to x is (D(x + r) - D(x - r)) /
(2 r), and a walk along both histograms takes linear time.

Letters: R rays, B bins of a histogram, which has B + 1 sorted edges on every ray, P bins of a proposed one.
"""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.base.device import to_float64
from nerfloom.kernels import native
from nerfloom.kernels.dispatch import CPP, Operation
from nerfloom.kernels.known_gradient import KnownGradient

EPS = 1e-5
"""Added to proposed weights in a denominator. The paper's code has 1.2e-7 and clips gradients, which we do not. A bin
with little weight contributes at most its excess squared, divided by 4 EPS, to the gradient of its density."""


def blurred_weights(edges: Tensor, weights: Tensor, proposed: Tensor, radius: float) -> Tensor:
    """Return the weights (R, P) of other bins in a histogram blurred with a box.

    Computed in float64, because differences of integrals are divided by the width of the box.

    Args:
        edges: (R, B + 1) sorted edges of the histogram.
        weights: (R, B) weights of its bins.
        proposed: (R, P + 1) sorted edges of the other bins.
        radius: half the width of the box, in the units of the edges; more than 0.
    """
    edge, weight, x = (to_float64(values) for values in (edges, weights, proposed))
    width, zero = edge.diff(dim=-1), torch.zeros_like(edge[:, :1])
    mass = torch.cat([zero, weight.cumsum(-1)], dim=-1)
    area = torch.cat([zero, ((mass[:, 1:] + mass[:, :-1]) / 2 * width).cumsum(-1)], dim=-1)
    none = width <= 0
    slope = torch.cat([(weight / width.masked_fill(none, 1)).masked_fill(none, 0), zero], dim=-1)  # none at the end

    def second_integral(x: Tensor) -> Tensor:
        bins = (torch.searchsorted(edge, x, right=True) - 1).clamp(min=0)
        past = (x - edge.gather(-1, bins)).clamp(min=0)
        return area.gather(-1, bins) + past * (mass.gather(-1, bins) + slope.gather(-1, bins) * past / 2)

    integral = (second_integral(x + radius) - second_integral(x - radius)) / (2 * radius)
    return integral.diff(dim=-1)


def blurred_excess_reference(
    edges: Tensor, weights: Tensor, proposed: Tensor, proposed_weights: Tensor, radius: float
) -> Tensor:
    """Compute `blurred_excess` of `edges`, `weights`, `proposed`, `proposed_weights` and `radius` in PyTorch."""
    target = blurred_weights(edges, weights, proposed, radius).to(proposed_weights)
    excess = (target - proposed_weights).clamp(min=0)
    return (excess.square() / (proposed_weights + EPS)).sum(-1)


def blurred_excess(edges: Tensor, weights: Tensor, proposed: Tensor, proposed_weights: Tensor, radius: float) -> Tensor:
    """Return the loss (R,) of proposed weights below a blurred histogram's weights: Zip-NeRF's loss.

    It is the sum over proposed bins of max(0, b - p)^2 / p, where b is the weight of the blurred histogram in a bin and
    p the proposed one.

    Args:
        edges: (R, B + 1) sorted edges of the histogram; without a gradient.
        weights: (R, B) weights of its bins; without a gradient.
        proposed: (R, P + 1) sorted edges of the proposed histogram; without a gradient.
        proposed_weights: (R, P) weights of its bins.
        radius: half the width of the box, in the units of the edges.

    Raises:
        ValueError: if the radius is not positive.
    """
    if not radius > 0:
        raise ValueError(f"a histogram is blurred with a box of a radius above 0, not {radius}")
    edges, weights, proposed = edges.detach(), weights.detach(), proposed.detach()
    tensors = edges, weights, proposed, proposed_weights
    return BLURRED_EXCESS(tensors, *tensors, radius)


BLURRED_EXCESS = Operation("blurred_excess", blurred_excess_reference)


@BLURRED_EXCESS.implementation(CPP)
def _compiled(edges: Tensor, weights: Tensor, proposed: Tensor, proposed_weights: Tensor, radius: float) -> Tensor:
    inputs = (tensor.contiguous() for tensor in (edges, weights, proposed, proposed_weights))
    edges, weights, proposed, proposed_weights = inputs
    (rays, bins), proposed_bins = weights.shape, proposed_weights.shape[1]
    loss, gradient = weights.new_empty(rays), torch.empty_like(proposed_weights)
    _excess(
        native.pointer(edges, "edges", (rays, bins + 1)), native.pointer(weights, "weights", (rays, bins)), bins,
        native.pointer(proposed, "proposed edges", (rays, proposed_bins + 1)),
        native.pointer(proposed_weights, "proposed weights", (rays, proposed_bins)), proposed_bins, rays, radius,
        EPS, loss.data_ptr(), gradient.data_ptr(), native.threads(),
    )  # fmt: skip
    return KnownGradient.apply((loss, gradient), proposed_weights)


_excess = native.Function("blurred_excess", "ppqppqqdfppi")

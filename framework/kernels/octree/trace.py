"""Light along rays through an octree with trainable leaves; `light.py` has the equations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from nerfloom.geometry.rays import Rays
from nerfloom.kernels import native
from nerfloom.kernels.adam.row_gradient import RowGradient
from nerfloom.kernels.dispatch import CPP, TRITON, Operation
from nerfloom.kernels.octree.layout import OctreeLayout
from nerfloom.kernels.octree.light import (
    LAYOUT,
    RAYS,
    OctreeLight,
    check_leaves,
    contiguous,
    depths_of,
    light_of,
    outputs_of,
    ray_arguments,
)
from nerfloom.kernels.triton_backend import later

_trace = native.Function("octree_trace", LAYOUT + "ppi" + RAYS + "pfpppppi")
_backward: Callable[..., int] = native.Function("octree_trace_backward", LAYOUT + "ppiq" + RAYS + "pfppppppi", "q")


def trace_octree(
    layout: OctreeLayout, raw: Tensor, coefficients: Tensor, rays: Rays, background: Tensor, stop: float = 0.0,
    deferred: tuple[RowGradient, RowGradient] | None = None, peaks: Tensor | None = None,
) -> OctreeLight:  # fmt: skip
    """Return the light of R rays through an octree, with a gradient of its leaves; the reference has all gradients.

    Args:
        layout: where the L leaves are.
        raw: (L, 1) raw densities: the optical depth of a cell's edge is `depths_of(raw)`.
        coefficients: (L, 3 K) coefficients of K = 1, 4, 9 or 16 harmonics, channel by channel.
        background: (R, 3) or (3,) colour of the background.
        stop: transmittance below which a ray ends; see `error_bound`.
        deferred: collects the gradients of `raw` and `coefficients`, on compiled kernels; None to return them.
        peaks: (L,) largest weight of each leaf so far. The weights on these rays raise it in place: in the backward
            pass on compiled kernels, since its threads own leaves, and otherwise at once. None for none.
    """
    check_leaves(layout, raw, coefficients)
    background = background.expand(len(rays), 3)
    tensors = (raw, coefficients, rays.origins, rays.directions, background)
    return TRACE_OCTREE(tensors, layout, raw, coefficients, rays, background, stop, deferred, peaks)


def trace_octree_reference(
    layout: OctreeLayout, raw: Tensor, coefficients: Tensor, rays: Rays, background: Tensor, stop: float = 0.0,
    deferred: tuple[RowGradient, RowGradient] | None = None, peaks: Tensor | None = None,
) -> OctreeLight:  # fmt: skip
    """Compute `trace_octree` in PyTorch, on any device and for any float type.

    The gradient is autograd's. `layout`, `raw`, `coefficients`, `rays`, `background`, `stop`, `deferred` and `peaks`
    are as in `trace_octree`; `deferred` is not used.
    """
    return light_of(layout, depths_of(raw[:, 0]), coefficients, rays, background, stop, peaks)


TRACE_OCTREE: Operation[..., OctreeLight] = Operation("trace_octree", trace_octree_reference)


class _Trace(torch.autograd.Function):
    """The compiled form of `trace_octree`; the backward pass walks the rays again."""

    @staticmethod
    def forward(
        ctx: Any, raw: Tensor, coefficients: Tensor, placeholder: Tensor | None, layout: OctreeLayout, rays: Rays,
        background: Tensor, stop: float, deferred: tuple[RowGradient, RowGradient] | None, peaks: Tensor | None,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        out, addresses = outputs_of(rays)
        count, values = coefficients.shape
        _trace(
            *layout.arguments(), native.pointer(raw, "raw densities", (count, 1)),
            native.pointer(coefficients, "coefficients", (count, values)), values, *ray_arguments(rays),
            native.pointer(background, "the background", (len(rays), 3)), stop, *addresses, native.threads(),
        )  # fmt: skip
        ctx.save_for_backward(raw, coefficients, background)
        ctx.layout, ctx.rays, ctx.stop, ctx.deferred, ctx.peaks = layout, rays, stop, deferred, peaks
        ctx.mark_non_differentiable(out.moment, out.median, out.visits)
        ctx.set_materialize_grads(False)
        return tuple(out)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        (raw, coefficients, background), rays = ctx.saved_tensors, ctx.rays
        count, values = coefficients.shape
        color = torch.zeros_like(background) if grads[0] is None else grads[0].contiguous()
        opacity = None if grads[1] is None else grads[1].contiguous()
        leaves = None if ctx.deferred is None else torch.empty(count, dtype=torch.int32)
        make = torch.zeros_like if leaves is None else torch.empty_like  # memory that is not used is never there
        into = [make(raw), make(coefficients)]
        used = _backward(
            *ctx.layout.arguments(), raw.data_ptr(), coefficients.data_ptr(), values, count, *ray_arguments(rays),
            background.data_ptr(), ctx.stop, native.pointer(color, "the colour's gradient", (len(rays), 3)),
            None if opacity is None else native.pointer(opacity, "the opacity's gradient", (len(rays),)),
            native.pointer(into[0], "the densities' gradient", (count, 1)),
            native.pointer(into[1], "the coefficients' gradient", (count, values)),
            None if leaves is None else leaves.data_ptr(),
            None if ctx.peaks is None else native.pointer(ctx.peaks, "peaks", (count,)), native.threads(),
        )  # fmt: skip
        if leaves is not None:
            for kept, rows in zip(ctx.deferred, into, strict=True):
                kept.parts.append((leaves[:used], rows[:used]))
        found = into if leaves is None else [None, None]
        return (*found, None, None, None, None, None, None, None)


@TRACE_OCTREE.implementation(CPP, differentiable=2)
def _compiled(
    layout: OctreeLayout, raw: Tensor, coefficients: Tensor, rays: Rays, background: Tensor, stop: float = 0.0,
    deferred: tuple[RowGradient, RowGradient] | None = None, peaks: Tensor | None = None,
) -> OctreeLight:  # fmt: skip
    inputs = raw.contiguous(), coefficients.contiguous()
    placeholder = None
    if deferred is not None and torch.is_grad_enabled():  # autograd must see a reason to go backward
        inputs = inputs[0].detach(), inputs[1].detach()
        placeholder = torch.zeros(1, requires_grad=True)
    rest = layout, contiguous(rays), background.contiguous(), stop, deferred, peaks
    return OctreeLight(*_Trace.apply(*inputs, placeholder, *rest))


TRACE_OCTREE.implementation(TRITON, differentiable=2)(later("octree.trace_triton", "trace_octree"))

"""Small fully connected networks: linear layers without biases, ReLU between them (tiny-cuda-nn's FullyFusedMLP,
Mueller et al. 2021, "Real-time neural radiance caching", section 3).

Layers of at most 128 features are too small for a matrix library: most of its time goes into moving activations
through memory. The compiled kernel takes a block of samples through all layers while it stays in cache.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from framework.kernels import native

Activation = Literal["none", "relu", "sigmoid"]
CODES: dict[Activation, int] = {"none": 0, "relu": 1, "sigmoid": 2}
MAX_WIDTH = 128
MAX_LAYERS = 8


def mlp_reference(inputs: Sequence[Tensor], weights: Sequence[Tensor], activation: Activation = "none") -> Tensor:
    """The network as torch writes it: the truth, in any float type. Arguments as for `mlp`."""
    x = torch.cat([part.to(weights[0].dtype) for part in inputs], dim=-1)
    for weight in weights[:-1]:
        x = torch.relu(x @ weight.t())
    x = x @ weights[-1].t()
    if activation == "relu":
        return torch.relu(x)
    return torch.sigmoid(x) if activation == "sigmoid" else x


_forward = native.function("mlp_forward", "ppiqpipipi")
_backward = native.function("mlp_backward", "ppiqpipipppi")
_forward_bf16 = native.function("mlp_forward_bf16", "ppiqpipipi")
_backward_bf16 = native.function("mlp_backward_bf16", "ppiqpipipppi")


class _MLP(torch.autograd.Function):
    """The compiled network. Its backward pass computes hidden layers again, and skips samples without a gradient."""

    @staticmethod
    def forward(
        ctx: Any, activation: Activation, num_inputs: int, known: Tensor | None, bf16: bool, *tensors: Tensor
    ) -> Tensor:
        inputs, weights = tensors[:num_inputs], tensors[num_inputs:]
        call = _Call(inputs, weights)
        if known is not None:
            out = known.view_as(known)
        else:
            out = inputs[0].new_empty(call.count, weights[-1].shape[0])
            run = _forward_bf16 if bf16 else _forward
            run(*call.arguments, CODES[activation], out.data_ptr(), native.threads())
        ctx.save_for_backward(*tensors)
        ctx.activation, ctx.num_inputs, ctx.bf16 = activation, num_inputs, bf16
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        inputs, weights = ctx.saved_tensors[: ctx.num_inputs], ctx.saved_tensors[ctx.num_inputs :]
        call = _Call(inputs, weights)
        grad = grad.contiguous()
        needed = ctx.needs_input_grad[4 : 4 + len(inputs)]
        input_grads = [torch.empty_like(part) if wanted else None for part, wanted in zip(inputs, needed, strict=True)]
        weight_grads = [torch.empty_like(weight) for weight in weights]
        run = _backward_bf16 if ctx.bf16 else _backward
        run(
            *call.arguments, CODES[ctx.activation], native.pointer(grad, "the gradient", (call.count, grad.shape[1])),
            native.pointers([None if part is None else part.data_ptr() for part in input_grads]),
            native.pointers([weight.data_ptr() for weight in weight_grads]), native.threads(),
        )  # fmt: skip
        return None, None, None, None, *input_grads, *weight_grads


class _Call:
    """The arguments that forward and backward share, checked. Holds the C arrays alive."""

    def __init__(self, inputs: Sequence[Tensor], weights: Sequence[Tensor]) -> None:
        self.count = inputs[0].shape[0]
        parts = tuple(part.shape[1] for part in inputs)
        widths = (sum(parts), *(weight.shape[0] for weight in weights))
        self.arguments = (
            native.pointers([
                native.pointer(part, "an input", (self.count, width)) for part, width in zip(inputs, parts, strict=True)
            ]),
            native.integers(parts), len(parts), self.count, native.integers(widths), len(weights),
            native.pointers([
                native.pointer(weight, f"weight {layer}", (widths[layer + 1], widths[layer]))
                for layer, weight in enumerate(weights)
            ]),
        )  # fmt: skip


def mlp(
    inputs: Sequence[Tensor],
    weights: Sequence[Tensor],
    activation: Activation = "none",
    known: Tensor | None = None,
) -> Tensor:
    """A small network.

    Args:
        inputs: parts (N, D_i) that stand side by side: as if concatenated, without the copy.
        weights: (out, in) of each layer, as torch's Linear stores them.
        activation: of the output; ReLU stands between layers.
        known: the result, where it was computed before without a gradient: only the backward pass is left.
    Under autocast the compiled products are of bfloat16, summed in float32, where the processor has instructions for
    that, and of float32 elsewhere.

    Returns: (N, out of the last layer), float32. First derivatives only where compiled; see `mlp_reference`.
    Raises: ValueError where the widths do not fit together.
    """
    widths = [sum(part.shape[1] for part in inputs), *(weight.shape[0] for weight in weights)]
    if [weight.shape[1] for weight in weights] != widths[:-1]:
        shapes = ", ".join(str(tuple(weight.shape)) for weight in weights)
        raise ValueError(f"mlp: weights of shapes {shapes} do not fit inputs of {widths[0]} features")
    small = max(widths) <= MAX_WIDTH and len(weights) <= MAX_LAYERS
    if small and native.usable(*inputs, *weights):
        tensors = [x.contiguous() for x in (*inputs, *weights)]
        bf16 = torch.is_autocast_enabled("cpu") and native.has("mlp_forward_bf16")
        return _MLP.apply(activation, len(inputs), known, bf16, *tensors)
    return mlp_reference(inputs, weights, activation)

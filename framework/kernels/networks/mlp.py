"""Small fully connected networks: linear layers with ReLU between them.

They follow tiny-cuda-nn's FullyFusedMLP (Mueller et al. 2021, "Real-time neural radiance caching", section 3). For
layers of a few hundred features, a matrix library spends most of its time on moving activations through memory. The
compiled kernel computes all layers for a block of samples while it is in the cache.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import torch
from torch import Tensor
from torch.nn.functional import linear

from nerfloom.kernels import native, result_cache
from nerfloom.kernels.dispatch import CPP, Operation
from nerfloom.kernels.math import split_density

T = TypeVar("T")
Activation = Literal["none", "relu", "sigmoid"]
"""Activation function of the output."""
CODES: dict[Activation, int] = {"none": 0, "relu": 1, "sigmoid": 2}
"""Code of each activation function in the compiled kernels."""
MAX_WIDTH = 384
"""Maximum number of features of a layer in the compiled kernels."""
MAX_LAYERS = 8
"""Maximum number of layers in the compiled kernels."""


def mlp_reference(
    inputs: Sequence[Tensor], weights: Sequence[Tensor], activation: Activation = "none",
    biases: Sequence[Tensor] | None = None,
) -> Tensor:  # fmt: skip
    """Compute `mlp` of `inputs`, `weights`, `activation` and `biases` in PyTorch, with derivatives of any order."""
    x = torch.cat([part.to(weights[0].dtype) for part in inputs], dim=-1)
    for layer, weight in enumerate(weights):
        x = linear(torch.relu(x) if layer else x, weight, None if biases is None else biases[layer])
    if activation == "relu":
        return torch.relu(x)
    return torch.sigmoid(x) if activation == "sigmoid" else x


def density_mlp_reference(
    inputs: Sequence[Tensor], weights: Sequence[Tensor], biases: Sequence[Tensor] | None = None
) -> tuple[Tensor, Tensor]:
    """Compute `density_mlp` of `inputs`, `weights` and `biases` in PyTorch, on any device and for any float type."""
    return split_density(mlp_reference(inputs, weights, biases=biases))


_forward = native.Function("mlp_forward", "ppiqpippippi")
_backward = native.Function("mlp_backward", "ppiqpippippppppi")
_forward_bf16 = native.Function("mlp_forward_bf16", "ppiqpippippi")
_backward_bf16 = native.Function("mlp_backward_bf16", "ppiqpippippppppi")


class _MLP(torch.autograd.Function):
    """The compiled form of `mlp`, or of `density_mlp` if the plan says so.

    Backward recomputes hidden layers, and skips samples with a gradient of 0.
    """

    @staticmethod
    def forward(ctx: Any, plan: _Plan, *tensors: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        call = _Call(plan, tensors)
        density: Tensor | None = None

        def compute() -> Tensor:
            nonlocal density
            out = tensors[0].new_empty(call.count, call.outputs)
            density = out.new_empty(call.count) if plan.density else None
            run = _forward_bf16 if plan.bf16 else _forward
            place = None if density is None else density.data_ptr()
            run(*call.arguments, CODES[plan.activation], out.data_ptr(), place, native.threads())
            return out

        ctx.plan = plan
        out = result_cache.result(("mlp", plan), tensors[: plan.inputs], tensors[plan.inputs :], compute)
        if not plan.density:
            ctx.save_for_backward(*tensors)
            return out
        # If the output comes from a recorded call, so does the density.
        found = result_cache.result(
            ("density",), (out,), (), lambda: split_density(out)[0] if density is None else density
        )
        ctx.save_for_backward(*tensors, found)
        ctx.set_materialize_grads(False)
        return found, out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *incoming: Tensor | None) -> tuple[Tensor | None, ...]:
        plan, tensors, density, of_density = ctx.plan, ctx.saved_tensors, None, None
        if plan.density:
            (*tensors, density), (of_density, grad) = tensors, incoming
        else:
            (grad,) = incoming
        call = _Call(plan, tensors)
        of_density, grad = (None if each is None else each.contiguous() for each in (of_density, grad))
        grads = [
            torch.empty_like(tensor) if wanted or index >= plan.inputs else None
            for index, (tensor, wanted) in enumerate(zip(tensors, ctx.needs_input_grad[1:], strict=True))
        ]
        addresses = [None if g is None else g.data_ptr() for g in grads]
        grad_inputs, grad_weights, grad_biases = plan.split(addresses)
        run = _backward_bf16 if plan.bf16 else _backward
        run(
            *call.arguments, CODES[plan.activation],
            None if grad is None else native.pointer(grad, "the gradient", (call.count, call.outputs)),
            None if density is None else native.pointer(density, "the density", (call.count,)),
            None if of_density is None else native.pointer(of_density, "the density's gradient", (call.count,)),
            native.pointers(grad_inputs), native.pointers(grad_weights),
            native.pointers(grad_biases or [None] * plan.layers), native.threads(),
        )  # fmt: skip
        return None, *grads


@dataclass(frozen=True)
class _Plan:
    """The layout of a sequence of tensors: inputs, then weights, then biases if there are any."""

    inputs: int
    layers: int
    activation: Activation
    bf16: bool
    density: bool = False

    def split(self, values: Sequence[T]) -> tuple[Sequence[T], Sequence[T], Sequence[T]]:
        """Return the inputs, the weights, and the biases (none, or one per layer)."""
        last = self.inputs + self.layers
        return values[: self.inputs], values[self.inputs : last], values[last:]


class _Call:
    """The checked arguments shared by forward and backward; it keeps the C arrays alive."""

    def __init__(self, plan: _Plan, tensors: Sequence[Tensor]) -> None:
        inputs, weights, biases = plan.split(tensors)
        self.count, self.outputs = inputs[0].shape[0], weights[-1].shape[0]
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
            native.pointers([
                native.pointer(bias, f"bias {layer}", (widths[layer + 1],)) for layer, bias in enumerate(biases)
            ] or [None] * len(weights)),
        )  # fmt: skip


def mlp(
    inputs: Sequence[Tensor], weights: Sequence[Tensor], activation: Activation = "none",
    biases: Sequence[Tensor] | None = None,
) -> Tensor:  # fmt: skip
    """Return the output of a fully connected network with ReLU between its layers.

    The compiled form has first derivatives only. Under autocast it multiplies in bfloat16 and sums in float32 if the
    CPU has instructions for that, and computes in float32 otherwise.

    Args:
        inputs: parts (N, D_i) of the input, treated as concatenated along the features, without a copy.
        weights: (D_out, D_in) weights of each layer, as in `torch.nn.Linear`.
        activation: activation function of the output.
        biases: (D_out,) biases of each layer; None for no biases.

    Returns:
        (N, D_out) output of the last layer, float32.

    Raises:
        ValueError: if the widths of inputs and layers do not fit.
    """
    _check_widths(inputs, weights)
    return NETWORK((*inputs, *weights, *(biases or ())), inputs, weights, activation, biases)


def _check_widths(inputs: Sequence[Tensor], weights: Sequence[Tensor]) -> None:
    widths = [sum(part.shape[1] for part in inputs), *(weight.shape[0] for weight in weights)]
    if [weight.shape[1] for weight in weights] != widths[:-1]:
        shapes = ", ".join(str(tuple(weight.shape)) for weight in weights)
        raise ValueError(f"mlp: weights of shapes {shapes} do not fit inputs of {widths[0]} features")


NETWORK = Operation("mlp", mlp_reference)


def _is_small(inputs: Sequence[Tensor], weights: Sequence[Tensor], *rest: Any, **named: Any) -> bool:
    return len(weights) <= MAX_LAYERS and all(max(weight.shape) <= MAX_WIDTH for weight in weights)


@NETWORK.implementation(CPP, fits=_is_small)
def _compiled(
    inputs: Sequence[Tensor], weights: Sequence[Tensor], activation: Activation = "none",
    biases: Sequence[Tensor] | None = None,
) -> Tensor:  # fmt: skip
    return _apply(_Plan(len(inputs), len(weights), activation, multiplies_bf16()), inputs, weights, biases)


def multiplies_bf16() -> bool:
    """Return whether networks multiply in bfloat16: under autocast, on processors that support it."""
    return torch.is_autocast_enabled("cpu") and native.has("mlp_forward_bf16")


def _apply(
    plan: _Plan, inputs: Sequence[Tensor], weights: Sequence[Tensor], biases: Sequence[Tensor] | None
) -> Any:  # fmt: skip
    return _MLP.apply(plan, *(x.contiguous() for x in (*inputs, *weights, *(biases or ()))))


def density_mlp(
    inputs: Sequence[Tensor], weights: Sequence[Tensor], biases: Sequence[Tensor] | None = None
) -> tuple[Tensor, Tensor]:
    """Return the density (N,) and the outputs (N, D_out) of a network with the log-density as first output.

    It equals `nerfloom.kernels.math.split_density` of `mlp`, without separate passes over the outputs and their
    gradient. `inputs`, `weights`, `biases` and errors are as in `mlp`.
    """
    _check_widths(inputs, weights)
    return DENSITY_NETWORK((*inputs, *weights, *(biases or ())), inputs, weights, biases)


DENSITY_NETWORK: Operation[..., tuple[Tensor, Tensor]] = Operation("density_mlp", density_mlp_reference)


@DENSITY_NETWORK.implementation(CPP, fits=_is_small)
def _compiled_density(
    inputs: Sequence[Tensor], weights: Sequence[Tensor], biases: Sequence[Tensor] | None = None
) -> tuple[Tensor, Tensor]:
    plan = _Plan(len(inputs), len(weights), "none", multiplies_bf16(), density=True)
    density, out = _apply(plan, inputs, weights, biases)
    return density, out

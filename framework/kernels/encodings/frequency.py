"""Frequency encoding: NeRF (Mildenhall et al. 2020), equation 4."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from nerfloom.kernels import native, result_cache
from nerfloom.kernels.dispatch import CPP, TRITON, Operation
from nerfloom.kernels.math import at_least_float32
from nerfloom.kernels.triton_backend import later

MAX_FREQUENCIES = 32
"""Maximum number of frequencies. In float32 the sines of the highest ones are noise even earlier."""

_forward = native.Function("frequency_encoding", "pqiiipi")
_backward = native.Function("frequency_encoding_backward", "ppqiiipi")


def frequency_encoding_reference(x: Tensor, num_frequencies: int, include_input: bool = True) -> Tensor:
    """Compute `frequency_encoding` of `x`, `num_frequencies` and `include_input` in PyTorch, on any device."""
    x = at_least_float32(x)
    scales = 2.0 ** torch.arange(num_frequencies, device=x.device, dtype=x.dtype)
    angles = x[..., None, :] * scales[:, None]
    waves = torch.stack([angles.sin(), angles.cos()], dim=-2).flatten(-3)
    return torch.cat([x, waves], dim=-1) if include_input else waves


class _FrequencyEncoding(torch.autograd.Function):
    """The compiled form of `frequency_encoding`."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, num_frequencies: int, include_input: bool) -> Tensor:
        count, dims = x.shape
        address = native.pointer(x, "the input", (count, dims))

        def compute() -> Tensor:
            out = x.new_empty(count, dims * (2 * num_frequencies + include_input))
            _forward(address, count, dims, num_frequencies, include_input, out.data_ptr(), native.threads())
            return out

        rows = result_cache.result(("frequency_encoding", num_frequencies, include_input), (x,), (), compute)
        ctx.save_for_backward(rows)
        ctx.settings = dims, num_frequencies, include_input
        return rows

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        (rows,) = ctx.saved_tensors
        grad, out = grad.contiguous(), rows.new_empty(len(rows), ctx.settings[0])
        address = native.pointer(grad, "the gradient", tuple(rows.shape))
        _backward(rows.data_ptr(), address, len(rows), *ctx.settings, out.data_ptr(), native.threads())
        return out, None, None


def frequency_encoding(x: Tensor, num_frequencies: int, include_input: bool = True) -> Tensor:
    """Return the sines and cosines of x times 1, 2, 4, ..., 2^(L - 1).

    The factor pi of equation 4 is omitted, as in the authors' code. float32 resolves the highest frequency only if
    |x| * 2^(L - 1) is well below 10^5, so x should be of magnitude 1. The compiled form has first derivatives only.

    Args:
        x: (..., D) input, of any float type.
        num_frequencies: number L of frequencies, 0 to 32.
        include_input: whether the result starts with x itself.

    Returns:
        (..., D * (2 L + include_input)) values x, sin(x), cos(x), sin(2 x), cos(2 x), ...; float64 if `x` is float64,
        and float32 otherwise.

    Raises:
        ValueError: if the number of frequencies is out of range.
    """
    if not 0 <= num_frequencies <= MAX_FREQUENCIES:
        raise ValueError(f"a frequency encoding has 0 to {MAX_FREQUENCIES} frequencies, not {num_frequencies}")
    x = at_least_float32(x)  # in half precision 2^9 x overflows from x = 128 on
    return FREQUENCY_ENCODING((x,), x, num_frequencies, include_input)


FREQUENCY_ENCODING = Operation("frequency_encoding", frequency_encoding_reference)


@FREQUENCY_ENCODING.implementation(CPP, fits=lambda x, *_: x.ndim >= 2)
def _compiled(x: Tensor, num_frequencies: int, include_input: bool = True) -> Tensor:
    rows = x.flatten(0, -2).contiguous()
    return _FrequencyEncoding.apply(rows, num_frequencies, include_input).unflatten(0, x.shape[:-1])


FREQUENCY_ENCODING.implementation(TRITON, fits=lambda x, *_: x.ndim >= 2)(
    later("encodings.encodings_triton", "frequency_encoding")
)

"""Small networks: compiled against the reference in float64, and where they go wrong first."""

import math
from collections.abc import Callable
from itertools import pairwise

import pytest
import torch
from torch import nn

from nerfloom.fields.base import MLP
from nerfloom.kernels import native
from nerfloom.kernels.math import MAX_LOG_DENSITY
from nerfloom.kernels.networks.mlp import Activation, density_mlp, density_mlp_reference, mlp, mlp_reference
from tests.kernels.compiled import needs_kernels, relative_error

SHAPES: list[tuple[tuple[int, ...], tuple[int, ...]]] = [
    ((32,), (64, 16)),
    ((16, 16), (64, 64, 3)),
    ((3,), (1,)),
    ((5, 1, 7), (17, 33, 2)),
    ((128,), (128, 128)),
    ((48,), (16, 96, 32, 16, 16, 16, 16, 80)),
    ((256, 63), (256, 256)),
]


def network(parts: tuple[int, ...], layers: tuple[int, ...], count: int, seed: int = 0):
    """Inputs and weights of a random network."""
    torch.manual_seed(seed)
    inputs = [torch.randn(count, part) for part in parts]
    widths = (sum(parts), *layers)
    weights = [torch.randn(b, a) * (2 / a) ** 0.5 for a, b in pairwise(widths)]
    return inputs, weights


def value_and_gradients(run: Callable, inputs, weights, activation: Activation, direction, dtype: torch.dtype):
    leaves = [t.to(dtype).requires_grad_() for t in (*inputs, *weights)]
    out = run(leaves[: len(inputs)], leaves[len(inputs) :], activation)
    return [out, *torch.autograd.grad((out * direction.to(out.dtype)).sum(), leaves)]


@needs_kernels
@pytest.mark.parametrize("activation", ["none", "relu", "sigmoid"])
@pytest.mark.parametrize(("parts", "layers"), SHAPES)
@pytest.mark.parametrize("count", [1, 31, 32, 333])
def test_equals_the_reference(parts, layers, count: int, activation: Activation) -> None:
    inputs, weights = network(parts, layers, count)
    direction = torch.randn(count, layers[-1])
    direction[::3] = 0  # samples without a gradient are left out of the backward pass
    truth = value_and_gradients(mlp_reference, inputs, weights, activation, direction, torch.float64)
    found = value_and_gradients(mlp, inputs, weights, activation, direction, torch.float32)
    for a, b in zip(found, truth, strict=True):
        assert a.shape == b.shape
        assert relative_error(a, b) < 2e-5


@pytest.mark.skipif(not native.has("mlp_forward_bf16"), reason="this processor multiplies no bfloat16")
@pytest.mark.parametrize(("parts", "layers"), SHAPES)
def test_bfloat16_products_err_as_rounded_inputs_do(parts, layers) -> None:
    """Every product of bfloat16 is off by 2^-8 at most; over the layers gradients must still point the same way."""
    inputs, weights = network(parts, layers, 500)
    direction = torch.randn(500, layers[-1])
    truth = value_and_gradients(mlp_reference, inputs, weights, "none", direction, torch.float64)

    def autocast(*arguments):
        with torch.autocast("cpu", torch.bfloat16):
            return mlp(*arguments)

    found = value_and_gradients(autocast, inputs, weights, "none", direction, torch.float32)
    assert relative_error(found[0], truth[0]) < 0.01 * len(layers)
    for a, b in zip(found, truth, strict=True):
        cosine = torch.nn.functional.cosine_similarity(a.double().flatten(), b.flatten(), dim=0).item()
        assert cosine > 1 - 2e-3 * len(layers)
        assert not torch.equal(a, b.float())  # it really was bfloat16


@needs_kernels
def test_extreme_inputs_stay_what_they_are() -> None:
    inputs, weights = network((8,), (16, 4), 70)
    for value in (0.0, 1e30, -1e30, 1e-40):
        inputs[0][3] = value
        truth = mlp_reference([x.double() for x in inputs], [w.double() for w in weights])
        assert relative_error(mlp(inputs, weights), truth) < 2e-5
    inputs[0][3, 2] = float("nan")
    out = mlp(inputs, weights)
    assert bool(out[3].isnan().all())
    assert bool(out[:3].isfinite().all() & out[4:].isfinite().all())
    saturated = mlp([torch.full((2, 1), 1e4) * torch.tensor([[1.0], [-1.0]])], [torch.ones(1, 1)], "sigmoid")
    assert saturated.flatten().tolist() == [1.0, pytest.approx(0.0, abs=1e-30)]


@needs_kernels
def test_threads_agree_and_repeat_bit_for_bit() -> None:
    inputs, weights = network((32,), (64, 16), 1000)
    direction = torch.randn(1000, 16)
    before = torch.get_num_threads()
    try:
        found = {}
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            runs = [value_and_gradients(mlp, inputs, weights, "none", direction, torch.float32) for _ in range(2)]
            assert all(torch.equal(a, b) for a, b in zip(*runs, strict=True))
            found[threads] = runs[0]
    finally:
        torch.set_num_threads(before)
    for threads in (2, 3):
        assert all(torch.equal(a, b) for a, b in zip(found[threads], found[1], strict=True))


def test_gradcheck_and_second_derivatives_of_the_reference() -> None:
    torch.manual_seed(0)
    leaves = [torch.randn(4, 3, dtype=torch.float64, requires_grad=True)]
    leaves += [torch.randn(5, 3, dtype=torch.float64, requires_grad=True)]
    leaves += [torch.randn(2, 5, dtype=torch.float64, requires_grad=True)]
    assert torch.autograd.gradcheck(lambda x, a, b: mlp([x], [a, b], "sigmoid"), leaves)
    assert torch.autograd.gradgradcheck(lambda x, a, b: mlp_reference([x], [a, b], "sigmoid"), leaves)


def test_empty_input_and_layers_too_wide_to_fuse() -> None:
    inputs, weights = network((4,), (8, 2), 0)
    out = mlp([inputs[0].requires_grad_()], [w.requires_grad_() for w in weights])
    assert out.shape == (0, 2)
    out.sum().backward()
    assert all(w.grad is not None and not w.grad.any() for w in weights)
    wide = MLP(200, 400, 5, bias=False)
    x = torch.randn(10, 200)
    torch.testing.assert_close(wide(x), mlp_reference([x], [wide[0].weight, wide[2].weight]))


@pytest.mark.parametrize("bfloat16", [False, True])
@pytest.mark.parametrize("activation", ["none", "relu", "sigmoid"])
def test_biases_and_activations(activation: Activation, bfloat16: bool) -> None:
    """Value and every gradient against torch's own layers in float64."""
    torch.manual_seed(0)
    net = MLP(40, 60, 33, activation=activation)
    x, direction = torch.randn(100, 40), torch.randn(100, 33)
    with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
        out = net(x[:, :1], x[:, 1:]).float()
    found = torch.autograd.grad((out * direction).sum(), list(net.parameters()))
    truth = nn.Sequential(nn.Linear(40, 60), nn.ReLU(), nn.Linear(60, 33)).double()
    truth.load_state_dict(net.state_dict())
    raw = truth(x.double())
    expected = {"none": raw, "relu": raw.relu(), "sigmoid": raw.sigmoid()}[activation]
    gradients = torch.autograd.grad((expected * direction).sum(), list(truth.parameters()))
    assert relative_error(out, expected) < (0.05 if bfloat16 else 2e-5)
    for a, b in zip(found, gradients, strict=True):
        if bfloat16:  # a rounded output may fall on ReLU's other side, so single samples count or do not
            assert torch.nn.functional.cosine_similarity(a.double().flatten(), b.flatten(), dim=0) > 0.995
        else:
            assert relative_error(a, b) < 4e-5


@pytest.mark.parametrize("asked", ["density", "outputs", "both"])
@pytest.mark.parametrize(("parts", "layers"), [((32,), (64, 16)), ((5, 3), (1,)), ((40,), (30, 17))])
def test_density_and_outputs_against_the_reference(parts, layers, asked: str) -> None:
    """Log-densities go from -30 to 40 and are clipped at 15; batches are not whole blocks."""
    inputs, weights = network(parts, layers, 333)
    weights[-1][0] *= 8
    of_density, of_outputs = torch.randn(333) * 1e-3, torch.randn(333, layers[-1])
    of_density[::3] = of_outputs[::3] = 0
    found = []
    for form, dtype in ((density_mlp, torch.float32), (density_mlp_reference, torch.float64)):
        leaves = [t.to(dtype).requires_grad_() for t in (*inputs, *weights)]
        density, out = form(leaves[: len(inputs)], leaves[len(inputs) :])
        terms = {"density": (density * of_density).sum(), "outputs": (out * of_outputs).sum()}
        loss = sum(terms.values()) if asked == "both" else terms[asked]
        found.append([density.log(), out, *torch.autograd.grad(loss, leaves)])
    assert found[1][0].max().item() == pytest.approx(MAX_LOG_DENSITY, abs=1e-9)
    for a, b in zip(*found, strict=True):
        assert a.shape == b.shape
        assert relative_error(a, b) < 1e-4


def test_the_density_is_its_own_derivative_and_nan_stays_where_it_is() -> None:
    """The density is exp(min(x, 15)); its slope by x is the value itself, beyond 15 too (Instant-NGP's trunc_exp)."""
    logs = torch.tensor([-100.0, -3.0, 0.0, 14.5, 16.0, 80.0, torch.nan], requires_grad=True)
    density, out = density_mlp([logs[:, None]], [torch.ones(1, 1)])
    (slope,) = torch.autograd.grad(density.sum(), logs)
    expected = torch.tensor([0.0, math.exp(-3), 1.0, math.exp(14.5), math.exp(15), math.exp(15)])
    torch.testing.assert_close(density[:6], expected, rtol=1e-6, atol=1e-37)
    torch.testing.assert_close(slope[:6], expected, rtol=1e-6, atol=1e-37)
    assert density[6:].isnan().tolist() == slope[6:].isnan().tolist() == [True]
    torch.testing.assert_close(out[:, 0], logs, equal_nan=True)


@pytest.mark.skipif(not native.has("mlp_forward_bf16"), reason="this processor multiplies no bfloat16")
def test_the_density_of_a_network_in_bfloat16_is_that_of_its_output() -> None:
    inputs, weights = network((32,), (64, 16), 500)
    with torch.autocast("cpu", torch.bfloat16):
        (density, out), alone = density_mlp(inputs, weights), mlp(inputs, weights)
    assert torch.equal(out, alone)
    torch.testing.assert_close(density, out[:, 0].clamp(max=MAX_LOG_DENSITY).exp(), rtol=1e-6, atol=0)


def test_weights_that_do_not_fit_are_named() -> None:
    with pytest.raises(ValueError, match=r"\(8, 5\), \(3, 8\) .*4 features"):
        mlp([torch.zeros(2, 4)], [torch.zeros(8, 5), torch.zeros(3, 8)])

"""Results kept for the backward pass: values and gradients equal a plain evaluation's, for every field."""

import math
import threading
from collections.abc import Callable
from functools import partial

import pytest
import torch
from torch import Tensor, nn

from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.encodings.planes import FeaturePlanes
from nerfloom.fields.base import MLP, Field
from nerfloom.fields.deformed import DeformedField
from nerfloom.fields.distance import GridDistance
from nerfloom.fields.encoded import DensityField, EncodedField
from nerfloom.fields.nerf import NeRFField
from nerfloom.fields.network_grid import NetworkGrid
from nerfloom.fields.surface import Sharpness, VolSDFField
from nerfloom.fields.tensor import VM, TensorField
from nerfloom.geometry.points import Points
from nerfloom.kernels import native, result_cache
from nerfloom.kernels.encodings.frequency import frequency_encoding
from nerfloom.kernels.grids.hash_grid import hash_grid
from nerfloom.kernels.networks.mlp import mlp
from nerfloom.kernels.result_cache import Waves
from nerfloom.methods.kplanes import ExplicitField
from tests.kernels.compiled import needs_kernels

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
COUNTS = (40, 0, 25, 25)
"""Samples of each wave."""
Density = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


def at(field: Field, positions: Tensor, times: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Return a field's density and features at positions."""
    return field.density(Points(positions, times))


class Plugin(nn.Module):
    """A hash grid and networks, which a subclass puts together in a way of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.grid = HashGrid(3, 2, 4, 16, 8)
        nn.init.normal_(self.grid.table)
        self.first, self.second = MLP(6, 8, 5), MLP(6, 8, 5)
        self.linear = nn.Linear(6, 6)

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        features = self.features(points.positions / 2 + 0.5)
        return features.square().sum(-1), features

    def features(self, unit: Tensor) -> Tensor:
        raise NotImplementedError


class LayersBetween(Plugin):
    """torch's layers stand between ours, and their results are rounded as the batch wants."""

    def features(self, unit: Tensor) -> Tensor:
        return self.first(torch.relu(self.linear(self.grid(unit))))


class TwoHeads(Plugin):
    """Two networks of one shape have the same input, and the first is not asked where there is nothing."""

    def features(self, unit: Tensor) -> Tensor:
        encoded = self.grid(unit)
        found = self.second(encoded)
        if bool((unit[:, 0] > 0.8).any()):
            found = found + self.first(encoded)
        return found


class SkippedOnReplay(Plugin):
    """The first of two networks of one shape is asked in waves alone."""

    calls = 0

    def features(self, unit: Tensor) -> Tensor:
        self.calls += 1
        encoded = self.grid(unit)
        unused = 0 * self.first(encoded) if self.calls <= len(COUNTS) else 0
        return unused + self.second(encoded)


class Sorted(Plugin):
    """Positions are looked up in an order of their own."""

    def features(self, unit: Tensor) -> Tensor:
        order = unit[:, 0].argsort()
        found = self.first(self.grid(unit[order]))
        return torch.empty_like(found).index_copy(0, order, found)


class Chunks(Plugin):
    """At most 42 positions are looked up at once: all of a wave, but not all chosen ones."""

    def features(self, unit: Tensor) -> Tensor:
        return torch.cat([self.first(self.grid(part)) for part in unit.split(42)])


class Masked(Plugin):
    """Only positions in one half are looked up."""

    def features(self, unit: Tensor) -> Tensor:
        inside = unit[:, 0] > 0.5
        found = self.first(self.grid(unit[inside]))
        return found.new_zeros(len(unit), 5).index_copy(0, inside.nonzero().squeeze(-1), found)


class InPlace(Plugin):
    """The results of our functions are changed in place."""

    def features(self, unit: Tensor) -> Tensor:
        return self.first(self.grid(unit).mul_(2))


class Codes(Plugin):
    """A network reads as many codes as some waves, or all that is chosen, have samples."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.codes = nn.Parameter(torch.randn(count, 6))

    def features(self, unit: Tensor) -> Tensor:
        codes = self.first(self.codes)
        chosen = (unit[:, 0] * len(codes)).long().clamp(0, len(codes) - 1)
        return self.second(self.grid(unit)) * codes[chosen]


class MadeWeights(Plugin):
    """The network's weights are computed."""

    def features(self, unit: Tensor) -> Tensor:
        return mlp([self.grid(unit)], [torch.tanh(layer.weight) for layer in (self.linear, self.first[0])])


def grid(sparse: bool = False) -> HashGrid:
    found = HashGrid(4, 2, 4, 32, 9, sparse=sparse)
    nn.init.normal_(found.table)
    return found


def nerf(**settings: int) -> NeRFField:
    return NeRFField(width=16, depth=4, skip=2, position_frequencies=4, **settings)


def moving(canonical: Field) -> DeformedField:
    found = DeformedField(canonical, width=16, depth=6, position_frequencies=3)
    nn.init.normal_(found.after_skip[-1].weight, std=0.1)
    return found


def tensors() -> TensorField:
    cubes = ((9, 9, 9),) * 3
    density, appearance = (FeaturePlanes(cubes, count, VM) for count in (4, 3))
    return TensorField(BOX, density, appearance, 8)


def cells() -> NetworkGrid:
    found = NetworkGrid(BOX, 3, width=8, position_frequencies=3)
    nn.init.normal_(found.trunk.table, std=0.3)
    found.trunk.deferred = None  # autograd accumulates this gradient too
    return found


SPACE, TIME = ((9, 9, 9), (17, 17, 17)), ((9, 9, 9, 4), (17, 17, 17, 4))
OURS: dict[str, Callable[[], nn.Module]] = {
    "hash grid": lambda: EncodedField(BOX, grid()),
    "contracted": lambda: EncodedField(BOX / 3, grid(), unbounded=True),
    "density alone": lambda: DensityField(BOX, grid()),
    "planes": lambda: EncodedField(BOX, FeaturePlanes(SPACE, 4)),
    "planes of time": lambda: EncodedField(BOX, FeaturePlanes(TIME, 4)),
    "explicit": lambda: ExplicitField(BOX, FeaturePlanes(SPACE, 4), 8),
    "tensors": tensors,
    "network": nerf,
    "networks of cells": cells,
    "network of time": lambda: nerf(time_frequencies=3),
    "deformed network": lambda: moving(nerf()),
    "deformed hash grid": lambda: moving(EncodedField(BOX, grid())),
    "layers between": LayersBetween,
    "weights that are computed": MadeWeights,
}
"""Fields; none of their compiled operations may be evaluated twice."""
UNUSUAL: dict[str, Callable[[], nn.Module]] = {
    "two heads": TwoHeads,
    "skipped on replay": SkippedOnReplay,
    "sorted": Sorted,
    "chunks": Chunks,
    "masked": Masked,
    "in place": InPlace,
    "codes as many as a wave": lambda: Codes(25),
    "codes as many as chosen": lambda: Codes(45),
}
"""Fields that lose some of the saving."""


def inputs() -> tuple[list[Tensor], list[Tensor]]:
    generator = torch.Generator().manual_seed(1)
    waves = [torch.rand(count, 3, generator=generator) * 1.6 - 0.8 for count in COUNTS]
    return waves, [torch.rand(count, generator=generator) for count in COUNTS]


def chosen(count: int = 45) -> Tensor:
    return torch.randperm(sum(COUNTS), generator=torch.Generator().manual_seed(2))[:count]


def in_waves(density: Density, order: Tensor) -> tuple[tuple[Tensor, ...], list[Tensor], set[str]]:
    """The chosen samples; the densities of the waves; the compiled functions that evaluated the chosen samples."""
    positions, times = inputs()
    waves, seen = Waves(), []
    for x, t in zip(positions, times, strict=True):
        seen.append(waves.evaluate(len(x), lambda x=x, t=t: density(x, t))[0].detach())
    native.spent = {}
    try:
        found = waves.choose(order, lambda: density(torch.cat(positions)[order], torch.cat(times)[order]))
        return found, seen, set(native.spent) - {"gather_rows", "group_rows"}  # which evaluate nothing
    finally:
        native.spent = None


def assert_as_plain(field: nn.Module, density: Density, order: Tensor) -> set[str]:
    """Compare values and gradients with one plain evaluation; return the compiled functions that ran meanwhile."""
    positions, times = inputs()
    found, seen, ran = in_waves(density, order)
    plain = density(torch.cat(positions)[order], torch.cat(times)[order])
    torch.testing.assert_close(torch.cat(seen)[order], plain[0].detach(), rtol=1e-4, atol=1e-5)
    grads = []
    for values in (found, plain):
        total = sum((value * torch.linspace(0.5, 2, value.numel()).view_as(value)).sum() for value in values)
        assert isinstance(total, Tensor)
        grads.append(torch.autograd.grad(total, list(field.parameters()), allow_unused=True))
    for value, true in zip(found, plain, strict=True):
        torch.testing.assert_close(value, true, rtol=1e-4, atol=1e-5)
    named = [name for name, _ in field.named_parameters()]
    for name, grad, true in zip(named, *grads, strict=True):
        assert (grad is None) == (true is None), name
        if grad is not None:
            scale = true.abs().max().item() or 1.0
            torch.testing.assert_close(grad, true, rtol=1e-3, atol=1e-4 * scale, msg=lambda m, n=name: f"{n}: {m}")
    assert any(grad is not None and bool(grad.any()) for grad in grads[0])
    return ran


@pytest.mark.parametrize("name", OURS)
def test_a_field_is_differentiated_and_not_evaluated_again(name: str) -> None:
    torch.manual_seed(0)
    field = OURS[name]()
    ran = assert_as_plain(field, partial(at, field), chosen())
    assert ran == set()


@needs_kernels
def test_a_distance_whose_levels_open_is_not_evaluated_again() -> None:
    """The weights of the open levels have new memory at each call, with the same values."""
    torch.manual_seed(0)
    opening = HashGrid(4, 2, 4, 32, 9, opening=0.5)
    nn.init.normal_(opening.table, std=0.01)
    assert opening.opening is not None
    opening.opening.opened.fill_(2.5)
    field = VolSDFField(BOX, GridDistance(BOX, opening, 0.5, 16), Sharpness(20.0, 1e-3), 16)
    assert "distance_network_forward" not in assert_as_plain(field, partial(at, field), chosen())


@needs_kernels
@pytest.mark.parametrize("name", UNUSUAL)
def test_an_unusual_field_is_right_all_the_same(name: str) -> None:
    torch.manual_seed(0)
    field = UNUSUAL[name]()
    assert_as_plain(field, partial(at, field), chosen())


@needs_kernels
def test_what_is_unusual_is_computed() -> None:
    """Or the cases above would show nothing."""
    torch.manual_seed(0)
    for name in ("sorted", "chunks", "in place"):
        field = UNUSUAL[name]()
        assert "hash_grid_forward" in assert_as_plain(field, partial(at, field), chosen()), name


@needs_kernels
def test_chance_is_not_repeated() -> None:
    """A field that moves its positions at random is given the values of where it looks, not of where it looked."""
    torch.manual_seed(0)
    field, last = EncodedField(BOX, grid()), []

    def density(positions: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
        last.append(positions + 0.1 * torch.randn(positions.shape))
        return at(field, last[-1])

    found, _, _ = in_waves(density, chosen())
    for value, true in zip(found, at(field, last[-1]), strict=True):
        torch.testing.assert_close(value, true)


@pytest.mark.parametrize("count", [20, 5])
def test_as_many_codes_as_samples_are_not_taken_for_them(count: int) -> None:
    """One wave, all or some of it chosen, and a network of as many rows that are in no order of the samples."""
    torch.manual_seed(0)
    field, positions, waves = Codes(count), torch.rand(20, 3), Waves()
    order = torch.arange(20).flip(0)[:count]
    waves.evaluate(20, lambda: at(field, positions, positions[:, 0]))
    found = waves.choose(order, lambda: at(field, positions[order], positions[order, 0]))
    torch.testing.assert_close(found[0], at(field, positions, positions[:, 0])[0][order])


@pytest.mark.parametrize("count", [0, 1, sum(COUNTS)])
def test_however_many_are_chosen(count: int) -> None:
    torch.manual_seed(0)
    field = EncodedField(BOX, grid())
    found, _, ran = in_waves(partial(at, field), chosen(count))
    assert [len(value) for value in found] == [count, count]
    assert all(value.requires_grad for value in found)
    assert ran <= ({"hash_grid_forward", "mlp_forward"} if count == 0 else set())


def test_the_tables_gradient_waits_once() -> None:
    """The optimiser gets the gradient of the chosen samples, and no other."""
    torch.manual_seed(0)
    field, order = EncodedField(BOX, grid(sparse=True)), chosen()
    found, _, _ = in_waves(partial(at, field), order)
    (found[0].sum() + found[1].square().sum()).backward()
    deferred = field.encoding.deferred
    assert deferred is not None
    if not native.available():
        assert not deferred.pending
        return
    assert field.encoding.table.grad is None
    grad = torch.zeros_like(field.encoding.table)
    deferred.add_to(grad)
    plain = hash_grid(field.unit(torch.cat(inputs()[0])[order]), field.encoding.table, field.encoding.layout)
    values = field.density_head(plain)
    (true,) = torch.autograd.grad(values[:, 0].exp().sum() + values.square().sum(), field.encoding.table)
    torch.testing.assert_close(grad, true, rtol=1e-3, atol=1e-4 * true.abs().max().item())


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_what_is_not_compiled_is_evaluated_once(kind: torch.dtype) -> None:
    """torch's own layers, and any field in float64: waves have their gradients, and rows are selected."""
    torch.manual_seed(0)
    layer = nn.Linear(3, 2, dtype=kind)
    asked = []

    def density(positions: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
        asked.append(len(positions))
        out = torch.sin(3 * layer(positions.to(kind)))
        if kind is torch.float64:
            out = mlp([out], [torch.eye(2, dtype=kind)])
        return out[:, 0].square(), out

    in_waves(density, chosen())
    assert asked == list(COUNTS)
    assert_as_plain(layer, density, chosen())


@needs_kernels
def test_large_layers_of_torch_are_not_evaluated_twice_for_an_encoding() -> None:
    """An encoding without parameters is not worth keeping."""
    torch.manual_seed(0)
    layer, asked = nn.Linear(15, 2), []

    def density(positions: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
        asked.append(len(positions))
        out = layer(frequency_encoding(positions, 2))
        return out[:, 0].square(), out

    in_waves(density, chosen())
    assert asked == list(COUNTS)


def test_without_gradients_rows_are_selected() -> None:
    torch.manual_seed(0)
    field, positions = EncodedField(BOX, grid()), torch.rand(30, 3)
    with torch.no_grad():
        waves = Waves()
        sigma, _ = waves.evaluate(30, lambda: at(field, positions))
        found, _ = waves.choose(torch.arange(30).flip(0), lambda: pytest.fail("nothing is left to evaluate"))
    assert not found.requires_grad
    assert torch.equal(found, sigma.flip(0))


@needs_kernels
def test_waves_build_no_graph() -> None:
    """But for the first, which shows whether the field's operations are ours."""
    torch.manual_seed(0)
    field, waves = EncodedField(BOX, grid()), Waves()
    found = [waves.evaluate(30, lambda: at(field, torch.rand(30, 3)))[0].requires_grad for _ in range(3)]
    assert found == [True, False, False]


@needs_kernels
def test_parameters_that_were_changed_meanwhile_count() -> None:
    torch.manual_seed(0)
    field, waves, positions = EncodedField(BOX, grid()), Waves(), torch.rand(30, 3)
    waves.evaluate(30, lambda: at(field, positions))
    with torch.no_grad():
        field.encoding.table.mul_(2)
    found, _ = waves.choose(torch.arange(30), lambda: at(field, positions))
    assert torch.equal(found, at(field, positions)[0])


class Broken(Exception):
    """The error of a field."""


@needs_kernels
@pytest.mark.parametrize("stage", ["first wave", "later wave", "choosing"])
def test_an_error_leaves_nothing_behind(stage: str) -> None:
    torch.manual_seed(0)
    field, waves = EncodedField(BOX, grid()), Waves()
    positions = torch.rand(30, 3)

    def broken() -> tuple[Tensor, ...]:
        at(field, positions)
        raise Broken

    if stage != "first wave":
        waves.evaluate(30, lambda: at(field, positions))
    with pytest.raises(Broken):
        waves.choose(torch.arange(30), broken) if stage == "choosing" else waves.evaluate(30, broken)
    assert torch.is_grad_enabled()
    assert result_cache._thread.tape is None


def test_another_thread_is_left_alone() -> None:
    """Evaluations of a second thread meanwhile are neither kept nor replaced."""
    torch.manual_seed(0)
    field, other = EncodedField(BOX, grid()), EncodedField(BOX, grid())
    elsewhere: list[Tensor] = []

    def density(positions: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
        thread = threading.Thread(target=lambda: elsewhere.append(at(other, positions)[0].detach()))
        thread.start()
        thread.join()
        return at(field, positions)

    ran = assert_as_plain(field, density, chosen())
    assert not native.available() or ran == {"hash_grid_forward", "mlp_forward"}  # the other's
    order, positions = chosen(), torch.cat(inputs()[0])
    torch.testing.assert_close(torch.cat(elsewhere[: len(COUNTS)]), at(other, positions)[0])
    torch.testing.assert_close(elsewhere[len(COUNTS)], at(other, positions[order])[0])


def test_waves_within_a_wave() -> None:
    """A field that is itself evaluated in waves."""
    torch.manual_seed(0)
    inner, outer = EncodedField(BOX, grid()), EncodedField(BOX, grid())

    def density(positions: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
        waves, parts = Waves(), positions.chunk(2)
        for part in parts:
            waves.evaluate(len(part), lambda part=part: at(inner, part))
        order = torch.arange(len(positions)).flip(0)
        sigma, _ = waves.choose(order, lambda: at(inner, positions[order]))
        mine, features = at(outer, positions)
        return mine + sigma.flip(0), features

    assert_as_plain(nn.ModuleList([inner, outer]), density, chosen())


def test_nan_is_kept() -> None:
    torch.manual_seed(0)
    field = EncodedField(BOX, grid())

    def density(positions: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
        return at(field, torch.where(positions[:, :1] > 0.5, math.nan, positions))

    found, seen, ran = in_waves(density, chosen())
    assert ran == set()
    broken = found[0].isnan()
    assert 0 < int(broken.sum()) < len(broken)
    assert torch.equal(broken, torch.cat(seen)[chosen()].isnan())

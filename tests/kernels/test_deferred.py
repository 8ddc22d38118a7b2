"""A table's gradient waits for the optimiser only where a backward pass asked for it."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.encodings.planes import FeaturePlanes
from nerfloom.kernels.grids.hash_grid_lookup import TableGradient
from nerfloom.kernels.grids.planes import PlanesGradient
from nerfloom.training.optim import Adam
from tests.kernels.compiled import needs_kernels, relative_error

pytestmark = needs_kernels
RESOLUTIONS = ((6, 7, 8), (11, 12, 13))
MAKERS: dict[str, Callable[[bool], HashGrid | FeaturePlanes]] = {
    "hash grid": lambda sparse: HashGrid(3, 2, 4, 24, 9, sparse=sparse),
    "planes": lambda sparse: FeaturePlanes(RESOLUTIONS, 4, sparse=sparse),
}


@pytest.fixture(params=MAKERS)
def make(request: pytest.FixtureRequest) -> Callable[[bool], HashGrid | FeaturePlanes]:
    def seeded(sparse: bool = True) -> HashGrid | FeaturePlanes:
        torch.manual_seed(0)
        encoding = MAKERS[request.param](sparse)
        torch.nn.init.normal_(encoding.table)
        return encoding

    return seeded


def positions() -> Tensor:
    return torch.rand(50, 3, generator=torch.Generator().manual_seed(1), requires_grad=True)


def waits(encoding: HashGrid | FeaturePlanes) -> int:
    """How many look-ups left a gradient."""
    assert encoding.deferred is not None
    bands = encoding.deferred.bands if isinstance(encoding.deferred, PlanesGradient) else []
    return len(encoding.deferred.parts) + len(bands)


def added_up(encoding: HashGrid | FeaturePlanes) -> Tensor:
    """(E, F) the gradient that waits, found by Adam without a memory and with a large epsilon: a gradient step."""
    deferred, table = encoding.deferred, encoding.table.detach().clone()
    assert deferred is not None
    moments = torch.zeros_like(table), torch.zeros_like(table), torch.zeros_like(table[:, 0])
    deferred.adam(table, *moments, 1e6, (0.0, 0.0), 1e6)
    return encoding.table.detach() - table


def test_a_gradient_of_positions_alone_leaves_nothing(make) -> None:
    """Gradients of a network's weights alone, and a pass with other inputs, leave nothing either."""
    encoding, x, weight = make(), positions(), torch.rand(encoding_width(make), requires_grad=True)
    features = encoding(x)
    (of_positions,) = torch.autograd.grad(features.sum(), x, retain_graph=True)
    assert of_positions.abs().max() > 0
    assert waits(encoding) == 0
    loss = (features @ weight).square().sum()
    torch.autograd.grad(loss, weight, retain_graph=True)
    loss.backward(inputs=[x, weight], retain_graph=True)
    assert waits(encoding) == 0
    loss.backward(inputs=[encoding.table], retain_graph=True)
    assert waits(encoding) == 1
    loss.backward()
    assert waits(encoding) == 2
    assert encoding.table.grad is None


def encoding_width(make) -> int:
    return make().num_features


def test_an_optimiser_does_not_apply_what_was_asked_of_positions(make) -> None:
    encoding, x = make(), positions()
    optimizer = Adam(
        [{"params": [encoding.table], "sparse": True}], {encoding.table: encoding.deferred}, 0.1, (0.9, 0.99), 1e-8
    )
    before = encoding.table.detach().clone()
    torch.autograd.grad(encoding(x).sum(), x)
    optimizer.step()
    assert torch.equal(encoding.table, before)
    encoding(x).sum().backward()
    optimizer.step()
    assert not torch.equal(encoding.table, before)


@pytest.mark.parametrize("times", [1, 2])
def test_what_waits_is_the_dense_gradient(make, times: int) -> None:
    """Two look-ups, and a second pass through the same graph, add up as dense gradients do."""
    encoding, dense, x = make(), make(sparse=False), positions()
    found = []
    for each in (encoding, dense):
        loss = each(x).square().sum() + each(x.detach() / 2).sin().sum()
        for _ in range(times):
            loss.backward(retain_graph=True)
        found.append(x.grad)
        x.grad = None
    assert torch.equal(*found)
    assert waits(encoding) == 2 * times
    assert dense.table.grad is not None
    assert relative_error(added_up(encoding), dense.table.grad) < 1e-3  # the step is rounded to the table's own digits
    assert waits(encoding) == 0


def test_without_gradients_nothing_waits(make) -> None:
    encoding, x = make(), positions()
    with torch.no_grad():
        assert not encoding(x).requires_grad
    encoding.table.requires_grad_(False)
    encoding(x).sum().backward()
    assert waits(encoding) == 0
    assert x.grad is not None


def test_autograd_grad_of_the_table_says_that_it_has_none(make) -> None:
    encoding = make()
    with pytest.raises(RuntimeError, match="appears to not have been used"):
        torch.autograd.grad(encoding(positions()).sum(), encoding.table)


def test_a_band_of_a_plane_waits_only_when_the_table_is_asked_for() -> None:
    planes = FeaturePlanes(RESOLUTIONS, 4, sparse=True)
    weight = torch.ones(4, requires_grad=True)
    loss = (planes.bands([(0, 0)])[0] * weight).sum()
    torch.autograd.grad(loss, weight, retain_graph=True)
    assert waits(planes) == 0
    loss.backward()
    assert waits(planes) == 1


def test_both_kinds_are_here() -> None:
    kinds = {type(make(True).deferred) for make in MAKERS.values()}
    assert kinds == {TableGradient, PlanesGradient}

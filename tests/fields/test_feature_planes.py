"""Resampled feature planes: looked-up values stay, and everything that depends on their size follows."""

from pathlib import Path

import pytest
import torch
from scipy.stats import chisquare

from nerfloom.encodings.planes import FeaturePlanes
from nerfloom.kernels.adam.adam import sparse_adam_reference
from nerfloom.training.checkpoint import load_checkpoint
from tests.training.helpers import assert_same_bits, tensors, tiny_trainer

VM = (((0, 1), (2,)), ((0, 2), (1,)), ((1, 2), (0,)))
FIRST, LATER = ((5, 6, 7),) * 3, ((9, 16, 19),) * 3


@pytest.mark.parametrize("axes", [None, VM])
def test_what_is_looked_up_stays(axes: tuple[tuple[tuple[int, ...], ...], ...] | None) -> None:
    """Along each axis the new vertices hold all of the old ones, so linear interpolation is the same everywhere."""
    torch.manual_seed(0)
    planes = FeaturePlanes(FIRST, 4, axes)
    positions = torch.rand(200, 3)
    before = planes(positions)
    finer = tuple(tuple(2 * (n - 1) + 1 for n in group) for group in FIRST)
    planes.resample(finer, torch.zeros(3), torch.ones(3))
    assert planes.table.shape[0] == planes.layout.num_entries
    torch.testing.assert_close(planes(positions), before, atol=1e-5, rtol=1e-5)


def test_a_part_of_the_box_is_cut_out() -> None:
    torch.manual_seed(0)
    planes = FeaturePlanes(FIRST, 4, VM)
    lower, upper = torch.tensor([0.25, 0.0, 0.5]), torch.tensor([0.75, 1.0, 1.0])  # at vertices of 5, 6 and 7
    inner = torch.rand(200, 3)
    before = planes(lower + inner * (upper - lower))
    planes.resample(((3, 6, 4),) * 3, lower, upper)
    torch.testing.assert_close(planes(inner), before, atol=1e-5, rtol=1e-5)


def test_another_size_is_loaded() -> None:
    torch.manual_seed(0)
    one, two = (FeaturePlanes(FIRST, 4, VM, sparse=True, resizable=True) for _ in range(2))
    one.resample(LATER, torch.zeros(3), torch.ones(3))
    two.load_state_dict(one.state_dict())
    assert two.layout == one.layout
    assert two.deferred is not None
    assert two.deferred.layout == one.layout
    positions = torch.rand(50, 3)
    torch.testing.assert_close(two(positions), one(positions), rtol=0, atol=0)


@pytest.mark.parametrize("axes", [None, VM])
def test_every_row_is_as_likely_in_a_band(axes: tuple[tuple[tuple[int, ...], ...], ...] | None) -> None:
    torch.manual_seed(0)
    planes = FeaturePlanes(((40, 40, 40),) * 3, 1, axes)
    height, across = planes.layout.shape(0, 0)
    with torch.no_grad():
        planes.layout.factor(planes.table, 0, 0).copy_(torch.arange(height)[:, None, None].expand(height, across, 1))
    counts = torch.zeros(height)
    for _ in range(4000):
        (band,) = planes.bands([(0, 0)])
        counts[band[:, 0, 0].long()] += 1
        assert len(band) <= 2
    assert chisquare(counts.numpy()).pvalue > 1e-3


def loss(planes: FeaturePlanes, positions: torch.Tensor) -> torch.Tensor:
    """A look-up, a band, and how much bands vary."""
    torch.manual_seed(1)
    bands = planes.bands([(0, 0)])[0].square().mean() + planes.variation([(0, 1), (1, 2)]).sum()
    return planes(positions).square().mean() + bands


@pytest.mark.parametrize("features", [3, 16, 32])
def test_gradients_that_wait_move_the_table_as_those_that_do_not(features: int) -> None:
    """One step of Adam from the gradient in `deferred`, and from autograd's own gradient."""
    tables = []
    for sparse in (True, False):
        torch.manual_seed(0)
        planes = FeaturePlanes(FIRST, features, sparse=sparse)
        loss(planes, torch.rand(30, 3)).backward()
        state = [torch.zeros_like(planes.table), torch.zeros_like(planes.table), torch.zeros(len(planes.table))]
        settings = 1e-2, (0.9, 0.95), 1e-12
        with torch.no_grad():
            if planes.deferred is not None and planes.deferred.pending:
                assert planes.table.grad is None
                planes.deferred.adam(planes.table, *state, *settings)
            else:
                assert planes.table.grad is not None
                sparse_adam_reference(planes.table, planes.table.grad, *state, *settings)
        tables.append(planes.table.detach())
    torch.testing.assert_close(tables[0], tables[1], atol=1e-6, rtol=1e-5)


@pytest.mark.medium
def test_tensorf_grows_shrinks_and_resumes(shared_tiny: Path, tmp_path: Path) -> None:
    """Resumed in the middle of growing, and between the two times that it shrinks."""
    settings = {"max_num_iterations": 300, "upsample_at": (0.01, 0.02, 0.03, 0.85, 0.9)}
    trainer = tiny_trainer("tensorf", shared_tiny, tmp_path / "whole", **settings)
    model, sizes, boxes, saved, kept = trainer.model, [], [], {}, {}
    for step in range(1, 301):
        trainer.train_step()
        sizes.append(model.size())
        boxes.append(model.field.box.clone())
        if step in (6, 260):
            saved[step] = trainer.save()
        if step in (30, 300):
            kept[step] = tensors(trainer)
    assert trainer.state.skipped == 0
    assert sizes[-1] > sizes[0] * 2
    assert len(set(sizes)) > 3
    assert bool((boxes[-1][1] - boxes[-1][0] < boxes[0][1] - boxes[0][0]).all())
    for start, end in ((6, 30), (260, 300)):
        again = tiny_trainer("tensorf", shared_tiny, tmp_path / str(start), **settings)
        again.restore(load_checkpoint(saved[start]))
        while again.state.step < end:
            again.train_step()
        assert_same_bits(kept[end], tensors(again))

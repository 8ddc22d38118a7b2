"""Levels that open from coarse to fine: the complete encoding times known factors, in value, gradient and update."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from nerfloom.encodings.coarse_to_fine import OpenLevels, opened_levels
from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.encodings.planes import FeaturePlanes
from nerfloom.fields.encoded import EncodedField
from nerfloom.fields.nerf import NeRFField, opened_frequencies
from nerfloom.geometry.points import Points
from nerfloom.kernels.encodings.frequency import frequency_encoding_reference
from nerfloom.training.optim import Adam
from tests.kernels.compiled import needs_kernels
from tests.training.helpers import assert_same_bits, tensors, tiny_trainer

SCALES = ((6, 7, 8), (11, 12, 13), (20, 21, 22))
Encoding = HashGrid | FeaturePlanes
MAKERS: dict[str, Callable[..., Encoding]] = {
    "hash grid": lambda **flags: HashGrid(6, 2, 4, 48, 9, **flags),
    "planes": lambda **flags: FeaturePlanes(SCALES, 4, **flags),
}


def made(kind: str, opened: float | None, **flags: bool) -> Encoding:
    """The same encoding each time, with levels up to `opened` open; None for one without levels that open."""
    torch.manual_seed(0)
    encoding = MAKERS[kind](opening=opened is not None, **flags)
    torch.nn.init.normal_(encoding.table)
    if encoding.opening is not None:
        encoding.opening.opened.fill_(opened)
    return encoding


def factors(encoding: Encoding, opened: float) -> Tensor:
    """The factor of each feature, level by level."""
    levels = 6 if isinstance(encoding, HashGrid) else 3
    each = [min(max(opened - level, 0.0), 1.0) for level in range(levels)]
    return torch.tensor(each).repeat_interleave(encoding.num_features // levels)


@pytest.mark.parametrize("progress", [0.0, 0.03, 0.25, 0.5, 0.77, 0.95, 1.0, 1.7])
def test_frequencies_open_as_freenerf_opens_them(progress: float) -> None:
    """Equation 5 with L frequencies of 3 numbers, by its program: a pointer at L t / T + 1, at most L."""
    count = 10
    pointer = min(count * progress + 1, count) if progress < 1 else count
    mask = [1.0] * int(pointer) + [pointer - int(pointer)] + [0.0] * count
    opened = opened_levels(count, 1, progress)
    found = [min(max(opened - level, 0.0), 1.0) for level in range(count)]
    assert found == pytest.approx(mask[:count])


def test_levels_open_once_and_stay_open() -> None:
    opening = OpenLevels(4, 1)
    seen = []
    for progress in (0.0, 0.1, 0.25, 0.6, 0.75, 1.0, 3.0):
        opening.advance(progress)
        seen.append((float(opening.opened), opening.count, opening.complete))
    expected = [(1.0, 1, False), (1.4, 2, False), (2.0, 2, False), (3.4, 4, False), *[(4.0, 4, True)] * 3]
    assert [(count, done) for _, count, done in seen] == [(count, done) for _, count, done in expected]
    assert [opened for opened, _, _ in seen] == pytest.approx([opened for opened, _, _ in expected], abs=2**-11)


@pytest.mark.parametrize("kind", MAKERS)
@pytest.mark.parametrize("opened", [1.0, 1.25, 2.0, 2.5, 2.999])
@pytest.mark.parametrize("sparse", [False, True])
def test_an_encoding_is_the_complete_one_times_the_factors(kind: str, opened: float, sparse: bool) -> None:
    some, every = made(kind, opened, sparse=sparse), made(kind, None)
    x = torch.rand(40, 3, requires_grad=True)
    weights = torch.randn(40, some.num_features)
    found, expected = some(x), every(x) * factors(every, opened)
    torch.testing.assert_close(found, expected)
    (of_positions,) = torch.autograd.grad((found * weights).sum(), x)
    (truth,) = torch.autograd.grad((expected * weights).sum(), x)
    torch.testing.assert_close(of_positions, truth, rtol=1e-4, atol=1e-4)


@needs_kernels
@pytest.mark.parametrize("kind", MAKERS)
@pytest.mark.parametrize("sparse", [False, True])
def test_a_step_changes_open_levels_as_it_would_in_the_complete_encoding(kind: str, sparse: bool) -> None:
    opened, x = 1.5, torch.rand(60, 3, generator=torch.Generator().manual_seed(3))
    after = []
    for encoding in (made(kind, opened, sparse=sparse), made(kind, None, sparse=sparse)):
        deferred = {} if encoding.deferred is None else {encoding.table: encoding.deferred}
        adam = Adam([{"params": [encoding.table], "sparse": sparse}], deferred, 0.1, (0.9, 0.99), 1e-8)
        scale = 1 if encoding.opening is not None else factors(encoding, opened)
        for _ in range(3):
            adam.zero_grad()
            (encoding(x) * scale).square().sum().backward()
            assert adam.has_gradient(encoding.table)
            adam.step()
        after.append(encoding.table.detach())
    torch.testing.assert_close(*after, rtol=1e-4, atol=1e-5)
    before = made(kind, None).table
    changed = (after[0] != before).any(1).nonzero()
    some = made(kind, opened)
    assert len(changed) > 0
    assert int(changed.max()) < some.layout.first(2).num_entries < some.layout.num_entries


@pytest.mark.parametrize("kind", MAKERS)
def test_once_all_levels_are_open_nothing_is_different(kind: str) -> None:
    some, every = made(kind, 0.0), made(kind, None)
    assert some.opening is not None
    some.opening.advance(1.0)
    x = torch.rand(30, 3)
    assert torch.equal(some(x), every(x))


@pytest.mark.parametrize("opened", [0.0, 0.5, 3.0, 3.25, 4.0])
def test_frequencies_of_positions(opened: float) -> None:
    opening = OpenLevels(4, 0)
    opening.opened.fill_(opened)
    x = torch.rand(20, 3) - 0.5
    each = [1.0] * 3 + [min(max(opened - level, 0.0), 1.0) for level in range(4) for _ in range(6)]
    expected = frequency_encoding_reference(x, 4) * torch.tensor(each)
    torch.testing.assert_close(opened_frequencies(x, 4, opening), expected, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("opened", [1.0, 2.5])
def test_closed_bands_of_directions_do_not_count(opened: float) -> None:
    """Colour is the same from everywhere with one band open; it depends on the direction with two and a half."""
    torch.manual_seed(0)
    field = EncodedField(torch.tensor([[-1.0] * 3, [1.0] * 3]), HashGrid(4, 2, 4, 16, 8), opening=True)
    assert field.direction_opening is not None
    field.direction_opening.opened.fill_(opened)
    features = torch.randn(1, field.num_features).expand(50, -1)
    colors = field.color(features, nn.functional.normalize(torch.randn(50, 3), dim=-1))
    spread = float((colors - colors[0]).detach().abs().max())
    assert spread < 1e-6 if opened == 1 else spread > 1e-3


def test_a_network_of_frequencies_is_smooth_while_they_are_closed() -> None:
    """Without frequencies the density is a network of the position alone: at 2 pi / 8 apart it is not periodic."""
    torch.manual_seed(0)
    field = NeRFField(32, 3, 2, opening=True)
    points = Points(torch.rand(200, 3))
    near = Points(points.positions + 1e-3)
    changes = []
    for progress in (0.0, 1.0):
        assert field.opening is not None
        field.opening.advance(progress)
        changes.append(float((field.density(points)[1] - field.density(near)[1]).detach().abs().mean()))
    assert changes[0] < 0.1 * changes[1]


def test_what_is_open_is_kept_in_checkpoints_and_complete_without() -> None:
    one, two = made("hash grid", 2.5), made("hash grid", 1.0)
    two.load_state_dict(one.state_dict())
    assert two.opening is not None
    assert (two.opening.count, float(two.opening.opened)) == (3, 2.5)
    two.load_state_dict(made("hash grid", None).state_dict())
    assert two.opening.complete
    assert "opening.opened" not in made("hash grid", None).state_dict()


@pytest.mark.parametrize("kind", ["instant-ngp", "kplanes", "vanilla-nerf", "nerfacto", "tensorf"])
def test_levels_open_with_the_budget(kind: str, shared_tiny: Path, tmp_path: Path) -> None:
    steps = 6
    trainer = tiny_trainer(kind, shared_tiny, tmp_path / "run", open_levels_until=0.5, max_num_iterations=steps)
    counts = []
    for _ in range(steps):
        trainer.train_step()
        counts.append([int(module.count) for module in trainer.model.modules() if isinstance(module, OpenLevels)])
    assert counts == sorted(counts)
    openings = [module for module in trainer.model.modules() if isinstance(module, OpenLevels)]
    assert all(opening.complete for opening in openings)
    assert bool(openings) == (kind != "tensorf")


def test_a_resumed_run_opens_levels_as_an_uninterrupted_one(shared_tiny: Path, tmp_path: Path) -> None:
    settings = {"open_levels_until": 0.9, "max_num_iterations": 8}
    whole = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "whole", **settings)
    half = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "half", **settings)
    for _ in range(6):
        whole.train_step()
    for _ in range(3):
        half.train_step()
    half.save()
    again = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "again", load_dir=half.checkpoint_folder, **settings)
    again.restore_as_configured()
    for _ in range(3):
        again.train_step()
    assert_same_bits(tensors(whole), tensors(again))
    assert math.ceil(opened_levels(4, 4, 0.0)) == 4

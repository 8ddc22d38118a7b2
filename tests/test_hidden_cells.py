"""Space that no training ray reaches: how it is found, and the term that keeps it solid."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from nerfloom.data.pixels.batch import draw_batch
from nerfloom.losses.surfaces import HiddenSpace
from nerfloom.losses.term import RenderedBatch
from nerfloom.renderable import parts
from nerfloom.samplers.occupancy import OccupancySampler
from nerfloom.scene import hidden_cells
from nerfloom.scene.hidden_cells import PERIOD, HiddenCells
from tests.test_surfaces import exact_ball
from tests.training.helpers import said_otherwise

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 3.0]])
SIDE = 8
CAPTURE = {"unbounded": True, "has_alpha": False}


def middles() -> Tensor:
    """The middle (n^3, 3) of each cell."""
    unit = (torch.cartesian_prod(*[torch.arange(SIDE)] * 3) + 0.5) / SIDE
    return torch.lerp(BOX[0], BOX[1], unit)


def test_cells_beside_those_with_samples_are_not_hidden() -> None:
    """After a whole period; samples without a length, and samples of the period before, do not count."""
    cells, everywhere = HiddenCells(BOX, SIDE), torch.ones(SIDE**3, dtype=torch.bool)
    first, second = torch.tensor([[-0.9, 0.1, 2.9]]), torch.tensor([[0.9, 0.9, -0.9]])
    assert not cells.at(middles(), everywhere).any()
    cells.note(torch.cat([first, second]), torch.tensor([0.1, 0.0]))
    cells.settle(PERIOD - 1)
    assert not cells.at(middles(), everywhere).any()
    edges = (BOX[1] - BOX[0]) / SIDE
    for step, at in ((PERIOD, first), (2 * PERIOD, second)):
        cells.settle(step)
        own = BOX[0] + ((at - BOX[0]) / edges).floor() * edges + edges / 2
        beside = ((middles() - own).abs() < 1.5 * edges).all(-1)
        assert 7 < int(beside.sum()) < 19
        assert torch.equal(cells.at(middles(), everywhere), ~beside)
        cells.note(second, torch.tensor([0.1]))
    some = torch.rand(SIDE**3, generator=torch.Generator().manual_seed(0)) < 0.5
    assert torch.equal(cells.at(middles(), some), ~beside & some)


def test_a_checkpoint_keeps_them_and_an_older_one_has_none() -> None:
    cells, other = HiddenCells(BOX, SIDE), HiddenCells(BOX, SIDE)
    cells.note(torch.zeros(1, 3), torch.ones(1))
    cells.settle(PERIOD)
    cells.note(torch.zeros(1, 3), torch.ones(1))
    other.load_state_dict(cells.state_dict())
    assert torch.equal(other.hidden, cells.hidden)
    assert torch.equal(other.reached, cells.reached)
    assert int(other.reached.sum()) == 1
    fresh = HiddenCells(BOX, SIDE)
    fresh.load_state_dict({})
    assert not fresh.hidden.any()


def test_the_term_is_the_mean_of_positive_distances_in_hidden_space() -> None:
    """Around a ball of radius 0.5 in a box of side 2: over all of space, over one half, and over none."""
    torch.manual_seed(0)
    trainer, field = exact_ball()
    model, (grid,) = trainer.model, parts(trainer.model, OccupancySampler)
    batch = draw_batch(trainer.train_set, 16, "white")
    term = HiddenSpace()
    assert not term.applies(batch, model)  # in a scene without a background
    cells = model.hidden = HiddenCells(grid.box, grid.resolution)
    assert term.applies(batch, model)
    shown = RenderedBatch(batch, model.render(batch.rays, batch.background), model, 0)
    grid.occupied.fill_(True)
    assert float(term(shown)) == 0  # type: ignore[arg-type]
    low, high = field.box
    places = torch.lerp(low, high, torch.rand(400_000, 3))
    truth = float(torch.relu(places.norm(dim=-1) - 0.5).mean()) / field.size
    cells.hidden.fill_(True)
    found = [term(shown) for _ in range(30)]
    assert float(torch.stack(found).mean()) == pytest.approx(truth, rel=0.02)  # type: ignore[arg-type]
    cells.hidden.view(grid.resolution, -1)[: grid.resolution // 2] = False
    half = torch.stack([term(shown) for _ in range(60)]).mean()  # type: ignore[misc]
    assert float(half) == pytest.approx(truth / 2, rel=0.04)
    half.backward()
    pulls = field.distance.second.grad  # of the hidden units, which are never negative
    assert pulls is not None
    assert bool((pulls[0] >= 0).all())
    assert bool(pulls[0].any())
    assert not pulls[1:].any()


def test_captures_have_hidden_space_and_other_scenes_have_none(shared_tiny: Path, tmp_path: Path) -> None:
    (tmp_path / "capture").mkdir()
    captured = said_otherwise("neus", shared_tiny, tmp_path / "capture", CAPTURE).model
    assert isinstance(captured.hidden, HiddenCells)
    for name, facts, settings in (("bounded", {}, {}), ("off", CAPTURE, {"hidden_loss_mult": 0.0})):
        (tmp_path / name).mkdir()
        assert said_otherwise("neus", shared_tiny, tmp_path / name, facts, **settings).model.hidden is None


@pytest.mark.medium
def test_a_capture_is_watched_and_learns(shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hidden cells are occupied ones; evaluations change nothing."""
    monkeypatch.setattr(hidden_cells, "PERIOD", 4)
    trainer = said_otherwise("neus", shared_tiny, tmp_path, CAPTURE, max_num_iterations=12)
    hidden = trainer.model.hidden
    assert hidden is not None
    trainer.train_step()
    reached = hidden.reached.clone()
    assert 0 < int(reached[:-1].sum()) < len(reached)
    batch = draw_batch(trainer.train_set, 200, "black")
    with torch.no_grad():
        trainer.model.eval().render(batch.rays, batch.background)
    assert torch.equal(hidden.reached, reached)
    trainer.model.train()
    losses = [trainer.train_step().losses for _ in range(9)]
    assert "hidden" in losses[-1]
    assert trainer.state.skipped == 0
    assert 0 < int(hidden.hidden.sum()) < len(hidden.hidden)

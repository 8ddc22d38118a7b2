"""Space that images show and no training ray reaches: how it is found, and the term that keeps it solid."""

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
from nerfloom.testing.ball import cameras_at
from tests.test_surfaces import exact_ball
from tests.training.helpers import said_otherwise

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 3.0]])
SIDE = 8
CAPTURE = {"unbounded": True, "has_alpha": False}
EVERYWHERE = torch.tensor([0.0, 0.0, 0.0, 10.0])


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> HiddenCells:
    """A grid of 8^3 cells that all are shown."""
    monkeypatch.setattr(hidden_cells, "CELLS", SIDE)
    cells = HiddenCells(BOX)
    cells.shown.fill_(True)
    return cells


def middles() -> Tensor:
    """The middle (n^3, 3) of each cell."""
    unit = (torch.cartesian_prod(*[torch.arange(SIDE)] * 3) + 0.5) / SIDE
    return torch.lerp(BOX[0], BOX[1], unit)


def test_cells_beside_those_with_samples_are_not_hidden(few: HiddenCells) -> None:
    """After a whole period; samples without a length, and samples of the period before, do not count."""
    first, second = torch.tensor([[-0.9, 0.1, 2.9]]), torch.tensor([[0.9, 0.9, -0.9]])
    few.note(torch.cat([first, second]), torch.tensor([0.1, 0.0]))
    few.settle(PERIOD - 1)
    assert not few.at(middles()).any()
    edges = (BOX[1] - BOX[0]) / SIDE
    for step, at in ((PERIOD, first), (2 * PERIOD, second)):
        few.settle(step)
        own = BOX[0] + ((at - BOX[0]) / edges).floor() * edges + edges / 2
        beside = ((middles() - own).abs() < 1.5 * edges).all(-1)
        assert 7 < int(beside.sum()) < 19
        assert torch.equal(few.at(middles()), ~beside)
        few.note(second, torch.tensor([0.1]))


def test_only_space_within_the_frames_of_enough_images_is_hidden(few: HiddenCells) -> None:
    """Two cameras that look at the origin from afar through narrow lenses: around their axes, or where these cross."""
    cameras = cameras_at(torch.tensor([[40.0, 0.0, 0.0], [0.0, 40.0, 0.0]]), 3.0, 100)  # frames 2.1 wide
    nearest = torch.full((2,), 0.1)
    x, y, z = middles().abs().unbind(-1)
    few.show(cameras, nearest, 1, EVERYWHERE)
    few.settle(PERIOD)
    hidden, aside = few.at(middles()), torch.minimum(x, y)
    assert bool(hidden[(z < 0.5) & (aside < 0.7)].all())
    assert not bool(hidden[(z > 1.1) | (aside > 0.8)].any())
    few.shown.zero_()
    nearest[1] = 100.0  # the second shows everything nearer than 100 to be empty
    few.show(cameras, nearest, 2, EVERYWHERE)
    few.settle(PERIOD)
    assert not few.at(middles()).any()


def test_space_outside_the_sphere_is_not_hidden(few: HiddenCells) -> None:
    """Although a camera shows all of the box: rays have no samples there, with or without a surface before it."""
    cameras = cameras_at(torch.tensor([[40.0, 0.0, 0.0]]), 30.0, 100)  # a frame 21 wide
    sphere = torch.tensor([0.0, 0.0, 0.5, 0.9])
    few.show(cameras, torch.full((1,), 0.1), 1, sphere)
    few.settle(PERIOD)
    assert torch.equal(few.at(middles()), (middles() - sphere[:3]).norm(dim=-1) <= 0.9)


def test_a_checkpoint_keeps_them_and_an_older_one_has_none(few: HiddenCells) -> None:
    few.note(torch.zeros(1, 3), torch.ones(1))
    few.settle(PERIOD)
    few.note(torch.zeros(1, 3), torch.ones(1))
    other, fresh = HiddenCells(BOX), HiddenCells(BOX)
    other.load_state_dict(few.state_dict())
    for name in ("shown", "reached", "hidden"):
        assert torch.equal(getattr(other, name), getattr(few, name))
    assert int(other.reached.sum()) == 1
    fresh.load_state_dict({})
    assert not fresh.hidden.any()


def test_the_term_is_the_mean_of_positive_distances_in_hidden_space() -> None:
    """Around a ball of radius 0.5 in a box of side 2: over all of space, over one half, and over none."""
    torch.manual_seed(0)
    trainer, field = exact_ball()
    model, (grid,) = trainer.model, parts(trainer.model, OccupancySampler)
    batch, term = draw_batch(trainer.train_set, 16, "white"), HiddenSpace()
    assert not term.applies(batch, model)  # in a scene without a background
    cells = model.hidden = HiddenCells(grid.box)
    assert term.applies(batch, model)
    shown = RenderedBatch(batch, model.render(batch.rays, batch.background), model, 0)

    def mean(times: int) -> Tensor:
        return torch.stack([term(shown) for _ in range(times)]).mean()  # type: ignore[misc]

    low, high = field.box
    places = torch.lerp(low, high, torch.rand(400_000, 3))
    truth = float(torch.relu(places.norm(dim=-1) - 0.5).mean()) / field.size
    grid.occupied.fill_(True)
    assert float(mean(1)) == 0
    cells.hidden.fill_(True)
    assert float(mean(30)) == pytest.approx(truth, rel=0.02)
    grid.occupied.view(grid.resolution, -1)[: grid.resolution // 2] = False
    assert float(mean(60)) == pytest.approx(truth / 2, rel=0.04)
    grid.occupied.fill_(True)
    cells.hidden.view(hidden_cells.CELLS, -1)[: hidden_cells.CELLS // 2] = False
    half = mean(60)
    assert float(half) == pytest.approx(truth / 2, rel=0.04)
    half.backward()
    pulls = field.distance.second.grad  # of the hidden units, which are never negative
    assert pulls is not None
    assert bool((pulls[0] >= 0).all())
    assert bool(pulls[0].any())
    assert not pulls[1:].any()


def test_captures_have_hidden_space_and_other_scenes_have_none(shared_tiny: Path, tmp_path: Path) -> None:
    (tmp_path / "capture").mkdir()
    captured = said_otherwise("neus", shared_tiny, tmp_path / "capture", CAPTURE)
    captured.prepare()
    assert isinstance(captured.model.hidden, HiddenCells)
    assert 0 < int(captured.model.hidden.shown.sum()) < 0.55 * hidden_cells.CELLS**3  # a ball is 52 % of its cube
    for name, facts, settings in (("bounded", {}, {}), ("off", CAPTURE, {"hidden_loss_mult": 0.0})):
        (tmp_path / name).mkdir()
        assert said_otherwise("neus", shared_tiny, tmp_path / name, facts, **settings).model.hidden is None


@pytest.mark.medium
def test_a_capture_is_watched_and_learns(shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Training rays alone are noted, and the term is one of the loss."""
    monkeypatch.setattr(hidden_cells, "PERIOD", 4)
    trainer = said_otherwise("neus", shared_tiny, tmp_path, CAPTURE, max_num_iterations=12)
    hidden = trainer.model.hidden
    assert hidden is not None
    trainer.train_step()
    reached = hidden.reached.clone()
    assert 0 < int(reached[:-1].sum()) < len(hidden.hidden)
    batch = draw_batch(trainer.train_set, 200, "black")
    with torch.no_grad():
        trainer.model.eval().render(batch.rays, batch.background)
    assert torch.equal(hidden.reached, reached)
    trainer.model.train()
    losses = [trainer.train_step().losses for _ in range(9)]
    assert "hidden" in losses[-1]
    assert trainer.state.skipped == 0
    assert int(hidden.hidden.sum()) < int(hidden.shown.sum())

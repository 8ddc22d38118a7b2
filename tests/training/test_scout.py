"""--robust scout: the tiles that a field's errors contradict, with people at known places, and the run around it."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from nerfloom import ConfigError
from nerfloom.base.config import TrainConfig
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.left_out import LeftOutTiles
from nerfloom.data.pixels.tiles import Tiles
from nerfloom.data.sources import SCOUTED_ALONG, Request
from nerfloom.registry import load_method
from nerfloom.stress.variants import chosen, with_distractors
from nerfloom.testing.scenes import ball_in_a_box, moving_ball
from nerfloom.training import trainer as trainer_module
from nerfloom.training.scout import (
    CELLS,
    MAX_STEPS,
    SHARE,
    Comparison,
    budget,
    compare,
    contradicted,
    quantiles,
    scores_of,
    scout,
)
from nerfloom.training.trainer import Trainer
from tests.exact_ball import ExactBall
from tests.training.helpers import assert_same_bits, tensors, tiny_trainer

IMAGES, ALONG, PROBES = 24, 24, 16
"""Images of the made-up comparisons, tiles along each side of one, and probes in a tile."""
SMALL: dict[str, Any] = {"log2_table_size": 12, "max_resolution": 64, "num_steps": 64, "samples_per_batch": 4096}
"""Settings of a small scout."""


def tiles_of(images: int = IMAGES, side: int = 4) -> Tiles:
    """Tiles of square images."""
    cameras = ball_in_a_box(8).cameras
    cameras = cameras[torch.arange(images) % len(cameras)]
    size = torch.full((images,), ALONG * side)
    return Tiles(dataclasses.replace(cameras, widths=size, heights=size), side)


def compared(errors: Tensor) -> Comparison:
    """A comparison of images that all show the same places side by side.

    Args:
        errors: (IMAGES, ALONG, ALONG, 3) mean errors of tiles.
    """
    means = errors.reshape(-1, 3)
    owners = torch.arange(len(means)).repeat_interleave(PROBES)
    seen_by = torch.zeros(CELLS**3 + 1, dtype=torch.int64)
    seen_by[: ALONG**2] = IMAGES
    sums = torch.cat([PROBES * means, torch.full_like(means[:, :1], PROBES)], -1)
    return Comparison(sums, owners, owners % ALONG**2, seen_by)


def crowd(share: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """People in a share of the tiles, as rectangles with one error each, and where they are."""
    errors, there = torch.zeros(IMAGES, ALONG, ALONG, 3), torch.zeros(IMAGES, ALONG, ALONG, dtype=torch.bool)
    for index in range(IMAGES):
        while there[index].float().mean() < share:
            row, column = (torch.randint(ALONG + 6, (2,), generator=generator) - 6).tolist()  # partly outside, too
            sign = 2.0 * torch.randint(2, (3,), generator=generator) - 1
            place = index, slice(max(row, 0), row + 8), slice(max(column, 0), column + 7)
            errors[place] = sign * (0.2 + 0.3 * torch.rand(3, generator=generator))
            there[place] = True
    return errors, there


@pytest.mark.parametrize("share", [0.1, 0.2, 0.4])
def test_people_are_found_among_errors_of_texture(share: float) -> None:
    """A tile beside a person may be left out too."""
    generator = torch.Generator().manual_seed(3)
    errors, there = crowd(share, generator)
    noise = 0.05 * torch.randn(errors.shape, generator=generator)
    out = contradicted(compared(errors + noise), tiles_of().neighbours()).view(there.shape)
    recall, precision = float(out[there].float().mean()), float(there[out].float().mean())
    print(f"{share:.0%}: {recall:.0%} of people found, {precision:.0%} of the left-out pixels are people")
    assert recall > 0.9
    assert precision > 0.5


def test_nothing_is_left_out_where_nothing_moves() -> None:
    noise = 0.05 * torch.randn(IMAGES, ALONG, ALONG, 3, generator=torch.Generator().manual_seed(4))
    assert not bool(contradicted(compared(noise), tiles_of().neighbours()).any())


def test_what_is_wrong_in_all_images_is_kept() -> None:
    """A part of the scene that the scout has not learnt: too bright in some images, too dark in others."""
    generator = torch.Generator().manual_seed(5)
    errors, there = crowd(0.1, generator)
    unknown = torch.zeros(ALONG, ALONG, dtype=torch.bool)
    unknown[10:16, 8:18] = True
    size = 0.15 + 0.1 * torch.rand(IMAGES, 1, 1, 1, generator=generator)
    sign = 2.0 * torch.randint(2, (IMAGES, 1, 1, 1), generator=generator) - 1
    errors = torch.where(unknown[None, ..., None] & ~there[..., None], size * sign, errors)
    out = contradicted(compared(errors), tiles_of().neighbours()).view(there.shape)
    away = ~torch.nn.functional.max_pool2d(there[:, None].float(), 5, 1, 2)[:, 0].bool()  # from people
    assert float(out[unknown.expand_as(there) & away].float().mean()) < 0.05
    assert float(out[there & ~unknown].float().mean()) > 0.9


def test_a_place_that_few_images_show_is_judged_as_any_other() -> None:
    """Fog before a camera is in its own image alone, where it explains a part of the error."""
    errors = torch.zeros(IMAGES, ALONG, ALONG, 3)
    errors[3, 5:12, 5:12] = 0.2
    look = compared(errors)
    fog = (look.owners // ALONG**2 == 3) & (errors[3, ..., 0] > 0).view(-1)[look.owners % ALONG**2]
    seen_by = look.seen_by.clone()
    seen_by[ALONG**2] = 1
    alone = Comparison(look.sums, look.owners, torch.where(fog, ALONG**2, look.cells), seen_by)
    for given in (look, alone):
        out = contradicted(given, tiles_of().neighbours()).view(IMAGES, ALONG, ALONG)
        assert bool(out[3, 5:12, 5:12].all())
        assert not bool(out[torch.arange(IMAGES) != 3].any())


def test_scores_against_filters_in_float64() -> None:
    generator = torch.Generator().manual_seed(6)
    errors = torch.randn(IMAGES, ALONG, ALONG, 3, generator=generator, dtype=torch.float64)
    found = scores_of(compared(errors).sums, tiles_of().neighbours()).view(IMAGES, ALONG, ALONG)
    padded = np.pad(errors.numpy(), ((0, 0), (1, 1), (1, 1), (0, 0)), mode="edge")
    line, inside = np.array([1, 2, 1]) / 4, range(3)
    blurred = sum(
        line[r] * line[c] * padded[:, r : r + ALONG, c : c + ALONG] for r in inside for c in inside
    )  # fmt: skip
    squares = np.pad((blurred**2).mean(-1), ((0, 0), (1, 1), (1, 1)), mode="edge")
    expected = sum(squares[:, r : r + ALONG, c : c + ALONG] for r in inside for c in inside) / 9
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-5)


def test_quantiles_of_groups_against_numpy() -> None:
    generator = torch.Generator().manual_seed(7)
    values, groups = torch.rand(500, generator=generator), torch.randint(9, (500,), generator=generator)
    groups[groups == 4] = 5  # an empty group
    found = quantiles(values, groups, 0.25)
    for group in groups.unique().tolist():
        expected = np.quantile(values[groups == group].numpy(), 0.25, method="lower")
        assert found[groups == group].tolist() == pytest.approx([float(expected)] * int((groups == group).sum()))


# -- a field that is exact --------------------------------------------------------------------------------------------


def over_white(dataset: Dataset) -> Tensor:
    """The colours (P, 3) of all pixels over white."""
    rgba = dataset.pixels.float() / 255
    return rgba[:, :3] * rgba[:, 3:] + 1 - rgba[:, 3:]


@pytest.mark.medium
def test_discs_are_found_by_a_field_that_shows_what_is_behind_them() -> None:
    """Each camera has three images. Four of eight cameras see a place, and discs often cover nearly all."""
    clean = chosen(ball_in_a_box(96), [*range(8)] * 3)
    dataset = with_distractors(clean, 0.2)
    changed = (over_white(dataset) - over_white(clean)).abs().amax(-1)
    found = {}
    for name, images in (("clean", clean), ("discs", dataset)):
        tiles = LeftOutTiles(images, SCOUTED_ALONG)
        assert tiles.tiles.side == 4
        out = contradicted(compare(ExactBall(images.scene), images, tiles.tiles), tiles.tiles.neighbours())
        tiles.state.copy_(out)
        found[name] = tiles.counting(torch.arange(len(images.pixels))) == 0
        kept = torch.zeros(len(images.pixels), dtype=torch.bool)
        kept[tiles.counted().pixels()] = True
        assert torch.equal(kept, ~found[name])
        maps = [tiles.tiles.over_image(tiles.left_out, index).reshape(-1) for index in range(len(images))]
        assert torch.equal(torch.cat(maps) == 1, found[name])
    assert not bool(found["clean"].any())
    recall = float(found["discs"][changed > 0.2].float().mean())
    precision = float((changed[found["discs"]] > 0.02).float().mean())
    print(f"{recall:.0%} of the discs found, {precision:.0%} of the left-out pixels are discs")
    assert recall > 0.95
    assert precision > 0.5


@pytest.mark.slow
def test_a_short_training_finds_more_in_discs_than_elsewhere() -> None:
    clean = ball_in_a_box(64)
    dataset = with_distractors(clean, 0.2)
    changed = (over_white(dataset) - over_white(clean)).abs().amax(-1) > 0.2
    shares = {}
    for name, images in (("clean", clean), ("discs", dataset)):
        tiles = LeftOutTiles(images, SCOUTED_ALONG)
        scout(Trainer, images, tiles, TrainConfig(), max_num_iterations=300, **SMALL)
        out = tiles.counting(torch.arange(len(images.pixels))) == 0
        shares[name] = float(out[changed].float().mean()), float(out[~changed].float().mean())
    print(shares)
    assert max(shares["clean"]) < 0.1
    assert shares["discs"][0] > 2 * shares["discs"][1]


# -- the run around it ------------------------------------------------------------------------------------------------


@pytest.fixture
def scouted(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """The budgets of all scouts, which leave out every third tile at once."""
    asked: list[dict[str, Any]] = []

    def found(train: Any, dataset: Dataset, tiles: LeftOutTiles, config: TrainConfig, **settings: Any) -> None:
        asked.append(settings)
        tiles.state.copy_(torch.arange(len(tiles.state)) % 3 == 0)

    monkeypatch.setattr(trainer_module, "scout", found)
    return asked


@pytest.mark.parametrize("method", ["instant-ngp", "gaussian-splatting"])
def test_a_run_leaves_out_what_its_scout_has_found(
    method: str, shared_tiny: Path, tmp_path: Path, scouted: list[dict[str, Any]]
) -> None:
    trainer = tiny_trainer(method, shared_tiny, tmp_path / "run", max_num_iterations=40, robust="scout")
    trainer.train_step()
    assert scouted == [{"max_num_iterations": round(40 * SHARE), "max_seconds": None}]
    tiles = trainer.source.contradicted
    assert tiles is not None
    assert 0.3 < float(tiles.share) < 0.4
    assert trainer.train_set.drawn is not None
    assert bool((tiles.counting(trainer.train_set.drawn.pixels()) == 1).all())
    batch = trainer.source.draw(Request(1, 200, progress=0.0))
    if method == "instant-ngp":
        assert bool((tiles.counting(batch.pixels) == 1).all())
    else:
        assert torch.equal(batch.weights, 1 - tiles.tiles.over_image(tiles.left_out, batch.index))


@pytest.mark.parametrize("method", ["instant-ngp", "gaussian-splatting"])
def test_a_resumed_run_has_the_same_tiles_and_bits_and_no_second_scout(
    method: str, shared_tiny: Path, tmp_path: Path, scouted: list[dict[str, Any]]
) -> None:
    settings = {"max_num_iterations": 12, "robust": "scout"}
    whole = tiny_trainer(method, shared_tiny, tmp_path / "whole", **settings)
    whole.train()
    first = tiny_trainer(method, shared_tiny, tmp_path / "first", **settings)
    for _ in range(5):
        first.train_step()
    first.save()
    second = tiny_trainer(method, shared_tiny, tmp_path / "second", load_dir=first.checkpoint_folder, **settings)
    second.restore_as_configured()
    second.train()
    assert len(scouted) == 2
    learnt, resumed = whole.source.state(), second.source.state()
    assert learnt is not None
    assert resumed is not None
    assert torch.equal(learnt, resumed)
    assert_same_bits(tensors(whole), tensors(second))


@pytest.mark.usefixtures("even_clock")
def test_a_scout_that_begins_in_a_resumed_run_counts_as_training(
    shared_tiny: Path, tmp_path: Path, scouted: list[dict[str, Any]]
) -> None:
    """What a resumed run prepares again does not count again."""
    first = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "first", max_num_iterations=4)
    first.train_step()
    first.save()
    for robust in ("off", "scout"):
        settings = {"robust": robust, "load_dir": first.checkpoint_folder, "max_num_iterations": 4}
        second = tiny_trainer("instant-ngp", shared_tiny, tmp_path / robust, **settings)
        second.restore_as_configured()
        second.prepare()
        assert (second.state.seconds > first.state.seconds) == (robust == "scout")
    assert len(scouted) == 1


@pytest.mark.medium
def test_a_scout_is_a_part_of_the_budget_and_its_training_is_thrown_away(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=40, robust="scout")
    before = tensors(trainer)
    trainer.prepare()
    assert trainer.source.contradicted is not None
    assert trainer.source.contradicted.known
    assert trainer.state.step == 0
    assert trainer.state.seconds > 0
    after = tensors(trainer)
    assert all(torch.equal(before[name], after[name]) for name in before if name.startswith("model.field"))


def test_the_budget_of_a_scout() -> None:
    def of(steps: int | None, seconds: float | None) -> tuple[int | None, float | None]:
        found = budget(TrainConfig(max_num_iterations=steps, max_seconds=seconds))
        return found["max_num_iterations"], found["max_seconds"]

    assert of(1000, None) == (round(1000 * SHARE), None)
    assert of(10**6, 100.0) == (MAX_STEPS, 100 * SHARE)
    assert of(None, 100.0) == (None, 100 * SHARE)
    assert of(None, None) == (MAX_STEPS, None)
    assert of(1, None) == (1, None)


def test_what_a_scout_cannot_learn_is_refused() -> None:
    method = load_method("moving-gaussians")
    config = dataclasses.replace(method.config, robust="scout")
    with pytest.raises(ConfigError, match="--robust scout: what moves would be left out, and moving-gaussians learns"):
        Trainer(method, config, moving_ball())
    still = ball_in_a_box()
    several = dataclasses.replace(still, scene=dataclasses.replace(still.scene, num_scenes=2))
    found = load_method("pixel-nerf")
    with pytest.raises(ConfigError, match="--robust scout: its field learns one scene"):
        Trainer(found, dataclasses.replace(found.config, robust="scout"), several)

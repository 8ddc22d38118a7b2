"""--robust errors: tiles that other images contradict are found from errors, and steps do not learn from them."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch

from nerfloom.base.plain import from_plain
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.batch import PixelBatch
from nerfloom.data.pixels.contradicted import (
    ALL_UNTIL,
    FADE,
    LEAST,
    MEMORY,
    MIN_DRAWS,
    STEPS_PER_LOOK,
    UNSHARP,
    ContradictedTiles,
    ContradictedViews,
    view_scores,
)
from nerfloom.data.pixels.left_out import MIN_SIDE
from nerfloom.data.pixels.pixel_set import PixelSet
from nerfloom.data.pixels.tiles import Tiles
from nerfloom.data.sources import BatchSource, Request, ViewSource, make_source
from nerfloom.losses.functions import mean_squared_error
from nerfloom.registry import load_method
from nerfloom.stress.scenes import ball_views
from nerfloom.training.step import forward
from nerfloom.training.trainer import Trainer

BALL = ball_views()
SIZES = [(19, 21), (33, 16), (4, 5)] * 4
"""Widths and heights of a dozen images."""
SMALL: dict[str, Any] = {
    "log2_table_size": 12,
    "max_resolution": 64,
    "num_steps": 64,
    "num_rays_per_batch": 1024,
    "samples_per_batch": None,
    "vis": "none",
}
"""Settings of a small field."""


def of_sizes() -> Any:
    widths, heights = torch.tensor(SIZES).T
    return dataclasses.replace(BALL.train.cameras, widths=widths, heights=heights)


@pytest.mark.parametrize("side", [4, 8])
def test_neighbours_of_a_tile_are_in_its_image(side: int) -> None:
    """Against a padded table of tile numbers for each image."""
    tiles, expected, first = Tiles(of_sizes(), side), list[np.ndarray](), 0
    for width, height in SIZES:
        rows, columns = -(-height // side), -(-width // side)
        table = np.pad(first + np.arange(rows * columns).reshape(rows, columns), 1, mode="edge")
        expected += [table[r : r + 3, c : c + 3].reshape(-1) for r in range(rows) for c in range(columns)]
        first += rows * columns
    assert tiles.total == first
    assert np.array_equal(tiles.neighbours().numpy(), np.stack(expected))


def learnt(count: int, steps: int, person: float, noise: float) -> tuple[ContradictedTiles, torch.Tensor]:
    """Tiles after random draws with errors of any sign, and a person in a corner of the first image, with errors of one
    sign. Returns the tiles and the pixels (P,) bool of the person."""
    torch.manual_seed(count)
    tiles, cameras = ContradictedTiles(BALL.train), BALL.train.cameras
    total, width = int(cameras.offsets[-1]), int(cameras.widths[0])
    pixels = torch.arange(total)
    side = 3 * tiles.tiles.side
    there = (pixels < cameras.offsets[1]) & (pixels % width < side) & (pixels // width < side)
    for _ in range(steps):
        drawn = torch.randint(total, (count,))
        errors = noise * torch.randn(count, 3)
        tiles.learn(drawn, torch.where(there[drawn, None], errors + person, errors))
    return tiles, there


@pytest.mark.parametrize("count", [256, 1024, 4096, 16_384, 65_536])
def test_batches_of_any_size_find_a_person(count: int) -> None:
    """Noise is as large as the person's error, so single squared errors do not tell them apart."""
    steps = max(400_000 // count, 3)
    tiles, there = learnt(count, steps, person=0.3, noise=0.3)
    tiles.decide(1.0)
    out = tiles.counting(torch.arange(len(there))) == 0
    assert float(out[there].float().mean()) > 0.8
    assert float(out[~there].float().mean()) < 0.05


@pytest.mark.parametrize("count", [256, 4096, 65_536])
def test_hardly_a_tile_is_left_out_where_nothing_moves(count: int) -> None:
    tiles, _ = learnt(count, max(400_000 // count, 3), person=0.0, noise=0.3)
    tiles.decide(1.0)
    assert float(tiles.share) < 0.02


def test_means_forget_as_stated_and_pass_over_what_is_not_finite() -> None:
    """The truth is in float64, with one pixel a step."""
    tiles = ContradictedTiles(BALL.train)
    sums, weight, kept = np.zeros(3), 0.0, np.exp(-1 / MEMORY)
    for step in range(100):
        errors = torch.tensor([[0.01 * step, -0.2, 0.3]])
        tiles.learn(torch.tensor([5]), errors)
        tiles.learn(torch.tensor([5]), torch.tensor([[torch.nan, 0.0, 0.0]]))
        sums, weight = sums * kept + errors[0].double().numpy(), weight * kept + 1
    here = int(tiles.tiles.of(torch.tensor([5])))
    found = tiles.state[here].double().numpy()
    np.testing.assert_allclose(found[:4], [*sums, weight], rtol=1e-5)
    assert not bool(tiles.state[torch.arange(len(tiles.state)) != here].any())


def test_all_pixels_count_at_first_and_without_draws() -> None:
    tiles, there = learnt(4096, 100, person=0.5, noise=0.1)
    tiles.decide(0.9 * ALL_UNTIL)
    assert float(tiles.share) == 0
    tiles.decide(ALL_UNTIL)
    assert float(tiles.counting(there.nonzero()[:, 0]).mean()) < 0.2
    few = ContradictedTiles(BALL.train)
    few.learn(torch.arange(MIN_DRAWS - 1), torch.ones(MIN_DRAWS - 1, 3))
    few.decide(1.0)
    assert float(few.share) == 0
    assert few.tiles.side >= MIN_SIDE


def contradicting(dataset: Dataset = BALL.train) -> tuple[BatchSource, torch.Tensor]:
    """A source with --robust and contradicted first tiles, and (P,) bool, whether a pixel is in them."""
    config = dataclasses.replace(load_method("instant-ngp").config, robust="errors")
    source = make_source("pixels", dataset, config)
    assert source.contradicted is not None
    source.contradicted.state[:5, 4] = 1
    return source, source.contradicted.counting(torch.arange(len(BALL.train.pixels))) == 0


def test_pixels_of_a_batch_have_weights_of_0_or_1() -> None:
    source, out = contradicting()
    batch = source.draw(Request(0, 2000))
    assert isinstance(batch, PixelBatch)
    assert batch.weights is not None
    assert torch.equal(batch.weights == 0, out[batch.pixels])
    assert 0 < float((batch.weights == 0).float().mean()) < 0.5


def test_left_out_pixels_have_no_known_distance() -> None:
    """Depth images show people too."""
    depths = torch.full((len(BALL.train.pixels),), 2.0, dtype=torch.float16)
    source, out = contradicting(dataclasses.replace(BALL.train, depths=depths))
    batch = source.draw(Request(0, 2000))
    assert batch.distances is not None
    assert torch.equal(batch.distances == 0, out[batch.pixels])
    assert float(batch.distances[~out[batch.pixels]].min()) >= 2


def test_the_psnr_of_training_is_that_of_pixels_that_count(monkeypatch: pytest.MonkeyPatch) -> None:
    found, seen = load_method("instant-ngp"), dict[str, Any]()
    trainer = Trainer(found, from_plain(found.config, {**SMALL, "robust": "errors"}, "test"), BALL.train)
    trainer.prepare()
    assert trainer.source.contradicted is not None
    trainer.source.contradicted.state[:40, 4] = 1
    monkeypatch.setattr(trainer.source, "learn", lambda request, batch, rgb: seen.update(batch=batch, rgb=rgb.clone()))
    trainer.train_step()
    errors, counts = (seen["rgb"] - seen["batch"].rgb).double().square(), seen["batch"].weights > 0
    assert 0 < float(counts.double().mean()) < 1
    assert trainer.state.train_mse == pytest.approx(float(errors[counts].mean()), rel=1e-4)


@pytest.mark.parametrize(("method", "rays"), [("instant-ngp", 512), ("vanilla-nerf", 64)])
def test_left_out_pixels_have_no_effect_on_colours(method: str, rays: int) -> None:
    """The colour loss is the mean of squared errors, 0 for left-out pixels, in one native call and by terms alike."""
    found = load_method(method)
    settings = {key: value for key, value in SMALL.items() if hasattr(found.config, key)}
    trainer = Trainer(
        found,
        from_plain(found.config, {**settings, "num_rays_per_batch": rays, "robust": "errors"}, "test"),
        BALL.train,
    )
    trainer.train_step()
    assert trainer.source.contradicted is not None
    trainer.source.contradicted.state[:40, 4] = 1
    batch = trainer.source.draw(Request(1, rays))
    loss = forward(trainer.model, batch, 1, 0.5)
    counting = trainer.source.contradicted.counting(batch.pixels)
    assert 0 < float(counting.mean()) < 1
    expected = float(((loss.rgb - batch.rgb).double().square().mean(-1) * counting).mean())
    assert float(loss.terms["rgb"].detach()) == pytest.approx(expected, rel=1e-4)


def test_a_resumed_source_decides_the_same() -> None:
    source, out = contradicting()
    for step in range(2 * STEPS_PER_LOOK):
        request = Request(step, 4096, progress=0.5)
        batch = source.draw(request)
        source.learn(request, batch, batch.rgb + 0.1 * torch.randn_like(batch.rgb) + 0.5 * out[batch.pixels, None])
    other = make_source("pixels", BALL.train, dataclasses.replace(load_method("instant-ngp").config, robust="errors"))
    other.restore(source.state())
    assert other.contradicted is not None
    assert source.contradicted is not None
    assert torch.equal(other.contradicted.state, source.contradicted.state)
    assert 0 < float(other.contradicted.share) < 0.5


def test_a_weighted_loss_against_its_definition() -> None:
    prediction, target, weights = torch.rand(5, 3), torch.rand(5, 3), torch.rand(5)
    by_hand = sum(weights[i].item() * (prediction[i, c] - target[i, c]).item() ** 2 for i in range(5) for c in range(3))
    assert mean_squared_error(prediction, target, weights).item() == pytest.approx(by_hand / 15, rel=1e-5)


# -- whole images -----------------------------------------------------------------------------------------------------

SPLATS = dataclasses.replace(load_method("gaussian-splatting").config, robust="errors")


def scores_by_hand(errors: np.ndarray, colors: np.ndarray, side: int) -> np.ndarray:
    """The scores of tiles in float64, tile by tile."""
    rows, columns = (-(-size // side) for size in errors.shape[:2])
    alone = np.zeros((rows, columns))
    for row in range(rows):
        for column in range(columns):
            tile = slice(row * side, (row + 1) * side), slice(column * side, (column + 1) * side)
            variance = colors[tile].reshape(-1, 3).var(0).mean()
            square = (errors[tile].reshape(-1, 3).mean(0) ** 2).mean()
            alone[row, column] = square * LEAST**2 / (LEAST**2 + UNSHARP**2 * variance)
    around = [[alone[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2].mean() for c in range(columns)] for r in range(rows)]
    return np.array(around)


@pytest.mark.parametrize(("height", "width", "side"), [(24, 24, 4), (19, 30, 8), (3, 11, 4), (5, 4, 8)])
def test_scores_of_a_whole_image_in_float64(height: int, width: int, side: int) -> None:
    torch.manual_seed(height)
    errors, colors = 0.3 * torch.randn(height, width, 3), torch.rand(height, width, 3)
    found = view_scores(errors, colors, side)
    expected = scores_by_hand(errors.double().numpy(), colors.double().numpy(), side)
    np.testing.assert_allclose(found.double().numpy(), expected, rtol=1e-4, atol=1e-8)
    errors[0, 0] = torch.nan
    assert bool(view_scores(errors, colors, side).isfinite().all())


def test_a_whole_image_shows_who_is_there_and_its_weights_fall_with_time() -> None:
    torch.manual_seed(0)
    views, side = ContradictedViews(BALL.train), ContradictedViews(BALL.train).tiles.side
    there = torch.zeros(24, 24, dtype=torch.bool)
    there[: 3 * side, : 3 * side] = True
    flat = torch.full((24, 24, 3), 0.5)
    for index in range(len(BALL.train)):
        noise = 0.1 * torch.randn(24, 24, 3)
        views.learn_view(index, noise + 0.4 * (there[..., None] & (index == 3)), flat, progress=0.5)
    assert [bool(views.tiles.of_image(views.state, index).any()) for index in range(12)] == [i == 3 for i in range(12)]
    for progress in (0.3, 0.5, 1.0):
        weights = views.weights(3, progress)
        assert weights is not None
        torch.testing.assert_close(weights[there], torch.full((9 * side**2,), math.exp(-(progress - ALL_UNTIL) / FADE)))
        assert bool((weights[5 * side :] == 1).all())
    assert views.weights(3, ALL_UNTIL) is None


def test_before_a_quarter_of_the_budget_nothing_is_decided_from_a_whole_image() -> None:
    views = ContradictedViews(BALL.train)
    views.learn_view(0, torch.ones(24, 24, 3), torch.zeros(24, 24, 3), 0.9 * ALL_UNTIL)
    assert float(views.share) == 0


def test_structure_that_is_not_sharp_yet_is_not_taken_for_people() -> None:
    """The same errors in a plain wall are; the median of the image is small."""
    rows, columns = torch.meshgrid(torch.arange(24), torch.arange(24), indexing="ij")
    errors = torch.zeros(24, 24, 3)
    errors[:8, :8] = 0.12
    chequered = ((rows + columns) % 2).float()[..., None].expand(-1, -1, 3)
    found = list[bool]()
    for colors in (torch.full((24, 24, 3), 0.5), chequered):
        views = ContradictedViews(BALL.train)
        views.learn_view(0, errors, colors, 1.0)
        found.append(bool(views.tiles.of_image(views.state, 0)[0, 0]))
    assert found == [True, False]


def test_views_have_the_weights_of_masks_and_tiles_and_distances_where_they_count() -> None:
    size = 24**2
    kept = PixelSet.of_mask(torch.arange(12 * size) % 24 > 2)
    depths = torch.full((12 * size,), 2.0, dtype=torch.float16)
    dataset = dataclasses.replace(BALL.train, kept=kept, depths=depths)
    source = make_source(
        "views", dataset, dataclasses.replace(load_method("gaussian-splatting").config, robust="errors")
    )
    assert isinstance(source, ViewSource)
    assert isinstance(source.contradicted, ContradictedViews)
    first = source.draw(Request(0, 0, progress=0.1))
    source.learn(Request(0, 0, progress=1.0), first, first.rgb + 0.5)  # as if all of it had changed, but the masked
    assert first.weights is not None
    masked = (torch.arange(24) <= 2).expand(24, -1)
    assert torch.equal(first.weights == 0, masked)
    assert first.index is not None
    source.contradicted.tiles.of_image(source.contradicted.state, first.index).copy_(torch.eye(6))
    other = make_source(
        "views", dataset, dataclasses.replace(load_method("gaussian-splatting").config, robust="errors")
    )
    other.restore(source.state())
    again = other.draw(Request(0, 0, progress=1.0))
    assert again.index == first.index
    out = torch.eye(6).repeat_interleave(4, 0).repeat_interleave(4, 1) == 1
    lost = math.exp(-(1 - ALL_UNTIL) / FADE)
    expected = torch.where(masked, 0.0, torch.where(out, lost, 1.0))
    torch.testing.assert_close(again.weights, expected)
    assert torch.equal(again.distances > 0, ~masked & ~out)


def test_the_errors_of_masked_pixels_are_not_judged() -> None:
    dataset = dataclasses.replace(BALL.train, kept=PixelSet.of_mask(torch.arange(12 * 24**2) % 24 >= 12))
    source = make_source(
        "views", dataset, dataclasses.replace(load_method("gaussian-splatting").config, robust="errors")
    )
    batch = source.draw(Request(0, 0))
    wrong = batch.rgb.clone()
    wrong[:, :12] += 0.9
    source.learn(Request(0, 0, progress=1.0), batch, wrong)
    assert source.contradicted is not None
    assert float(source.contradicted.share) == 0

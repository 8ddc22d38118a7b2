"""Drawing pixels by their error: it must not change what the loss is on average."""

from __future__ import annotations

import pytest
import torch

from nerfloom.cameras.cameras import Cameras
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.batch import draw_batch
from nerfloom.data.pixels.error_map import EVENLY, ErrorMap
from nerfloom.data.scene import Scene
from nerfloom.losses.functions import mean_squared_error


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    """Two photographs of unlike sizes, with alpha."""
    widths, heights, ones = torch.tensor([19, 33]), torch.tensor([21, 16]), torch.ones(2)
    pixels = torch.randint(256, (19 * 21 + 33 * 16, 4), generator=torch.Generator().manual_seed(0)).to(torch.uint8)
    cameras = Cameras(torch.eye(4)[:3].repeat(2, 1, 1), ones, ones, ones, ones, widths, heights)
    scene = Scene(torch.zeros(2, 3), 0, 1, 2, True, False, 33)
    return Dataset(pixels, cameras, None, ("a", "b"), scene, torch.eye(4)[:3], 1.0)


def test_squares_are_counted_through_images_of_unlike_sizes(dataset: Dataset) -> None:
    errors = ErrorMap(dataset)
    expected, next_square = [], 0
    for width, height in zip(dataset.cameras.widths.tolist(), dataset.cameras.heights.tolist(), strict=True):
        columns = -(-width // 8)
        expected += [next_square + y // 8 * columns + x // 8 for y in range(height) for x in range(width)]
        next_square += columns * -(-height // 8)
    assert errors.tiles.of(torch.arange(len(dataset.pixels))).tolist() == expected
    assert len(errors.errors) == next_square


@pytest.mark.medium
def test_the_weighted_mean_is_that_of_all_candidates(dataset: Dataset) -> None:
    """Monte Carlo over many draws from the same candidates, against the plain mean."""
    torch.manual_seed(0)
    errors = ErrorMap(dataset)
    errors.errors.copy_(torch.rand(len(errors.errors)).pow(8))  # very uneven
    candidates = torch.randint(len(dataset.pixels), (512,))
    value = torch.rand(len(dataset.pixels), dtype=torch.float64)
    means = []
    for _ in range(1000):
        pixels, weights = errors.draw(candidates, 128)
        assert weights.max() <= 1 / EVENLY + 1e-5
        means.append((value[pixels] * weights).mean())
    found = torch.stack(means)
    assert found.mean().item() == pytest.approx(
        value[candidates].mean().item(), abs=5 * found.std().item() / len(found) ** 0.5
    )


def test_large_errors_are_drawn_more_often_as_stated(dataset: Dataset) -> None:
    torch.manual_seed(0)
    errors = ErrorMap(dataset)
    everywhere = torch.arange(len(dataset.pixels))
    bad = errors.tiles.of(everywhere) == 3
    errors.learn(everywhere, torch.zeros(len(everywhere)))
    for _ in range(200):
        errors.learn(everywhere, bad.float())
    pixels, weights = errors.draw(everywhere, 20_000)
    share = bad.double().mean().item()
    expected = EVENLY * share + (1 - EVENLY)  # half evenly, half to the one square that is wrong
    assert bad[pixels].double().mean().item() == pytest.approx(expected, abs=0.01)
    assert weights.mean().item() == pytest.approx(1, abs=0.02)
    by_hand = torch.where(bad[pixels], 1 / (EVENLY + (1 - EVENLY) / share), 1 / EVENLY)
    torch.testing.assert_close(weights, by_hand.to(weights), rtol=1e-4, atol=0)


def test_figures_follow_what_is_learnt_and_pass_over_what_is_not_finite(dataset: Dataset) -> None:
    errors = ErrorMap(dataset)
    errors.learn(torch.tensor([0, 0, 8]), torch.tensor([0.5, 0.3, float("nan")]))
    assert errors.errors[0].item() == pytest.approx(1 + 0.2 * (0.4 - 1))
    assert (errors.errors[1:] == 1).all()


def test_a_batch_carries_weights_only_where_it_was_not_drawn_evenly(dataset: Dataset) -> None:
    torch.manual_seed(0)
    assert draw_batch(dataset, 64, "white").weights is None
    batch = draw_batch(dataset, 64, "white", ErrorMap(dataset))
    assert batch.weights is not None
    assert torch.allclose(batch.weights, torch.ones(64))  # nothing learnt yet: every square counts alike
    torch.testing.assert_close(batch.rgb, over_white(dataset, batch.pixels))


def over_white(dataset: Dataset, pixels: torch.Tensor) -> torch.Tensor:
    """Colours of pixels over white, by hand."""
    rgba = dataset.pixels[pixels].float() / 255
    return rgba[:, :3] * rgba[:, 3:] + (1 - rgba[:, 3:])


def test_weighted_loss_against_its_definition() -> None:
    prediction, target, weights = torch.rand(5, 3), torch.rand(5, 3), torch.rand(5)
    by_hand = sum(weights[i].item() * (prediction[i, c] - target[i, c]).item() ** 2 for i in range(5) for c in range(3))
    assert mean_squared_error(prediction, target, weights).item() == pytest.approx(by_hand / 15, rel=1e-5)

"""Colours of blocks: affine functions are found again, and change pictures and Gaussians as they say."""

from random import Random

import torch

from nerfloom.blocks.block import IDENTITY
from nerfloom.blocks.colors import (
    fitted_color,
    matching_order,
    recolored,
    recolored_gaussians,
)
from nerfloom.kernels.splats.project import DC
from nerfloom.rendering.light import without_background
from nerfloom.rendering.rendered import Picture
from nerfloom.splats.gaussians import Gaussians

COLOR = ((1.2, 0.1, 0.0, 0.05), (0.0, 0.8, 0.0, -0.02), (0.1, 0.0, 0.9, 0.1))
MATRIX = torch.tensor(COLOR, dtype=torch.float64)


def pixels(count: int, seed: int = 0) -> torch.Tensor:
    """Colours times opacity, and opacity."""
    random = torch.Generator().manual_seed(seed)
    opacity = torch.rand(count, 1, generator=random, dtype=torch.float64)
    return torch.cat([torch.rand(count, 3, generator=random, dtype=torch.float64) * opacity, opacity], dim=-1)


def picture(seed: int = 0) -> tuple[Picture, torch.Tensor]:
    """A half transparent picture and its background."""
    values, background = pixels(20, seed).float().view(4, 5, 4), torch.tensor([0.9, 0.5, 0.1])
    rgb = values[..., :3] + (1 - values[..., 3:]) * background
    depth = torch.ones(4, 5)
    return Picture(rgb, depth, depth, values[..., 3]), background


def test_the_function_is_found_again() -> None:
    torch.testing.assert_close(fitted_color(pixels(300), pixels(300) @ MATRIX.T, 0.0), MATRIX)
    torch.testing.assert_close(fitted_color(pixels(300), pixels(300) @ MATRIX.T), MATRIX, atol=0.03, rtol=0)


def test_it_is_the_least_of_its_sum_of_squares() -> None:
    """Its gradient is 0: by autograd."""
    seen, wanted, ridge = pixels(50), pixels(50, 1)[:, :3], 0.1
    found = fitted_color(seen, wanted, ridge).requires_grad_()
    away = (found - torch.tensor(IDENTITY, dtype=torch.float64)).square().sum()
    ((seen @ found.T - wanted).square().sum(-1).mean() + ridge * away).backward()
    assert found.grad is not None
    assert float(found.grad.abs().max()) < 1e-12


def test_without_pixels_colours_stay() -> None:
    found = fitted_color(torch.zeros(0, 4), torch.zeros(0, 3))
    torch.testing.assert_close(found, torch.tensor(IDENTITY, dtype=torch.float64))


def test_a_picture_changes_and_its_background_does_not() -> None:
    shown, background = picture()
    found = recolored(shown, COLOR, background)
    before, after = (without_background(each.rgb, each.accumulation, background) for each in (shown, found))
    torch.testing.assert_close(after[..., :3], before @ MATRIX.T.float(), atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(after[..., 3], shown.accumulation)
    torch.testing.assert_close(recolored(shown, IDENTITY, background).rgb, shown.rgb, atol=1e-6, rtol=1e-6)


def test_gaussians_change_as_pixels_do() -> None:
    """This holds for every direction, because colour is linear in the harmonics."""
    random = torch.Generator().manual_seed(0)
    means, turns = torch.zeros(5, 3), torch.tensor([1.0, 0, 0, 0]).repeat(5, 1)
    colors, harmonics = torch.randn(5, 3, generator=random), torch.randn(5, 3, 8, generator=random)
    gaussians = Gaussians(means, means, turns, torch.zeros(5), colors, harmonics)
    basis = torch.randn(8, generator=random)

    def color(those: Gaussians) -> torch.Tensor:
        return 0.5 + DC * those.colors + those.harmonics @ basis

    expected = color(gaussians) @ MATRIX[:, :3].T.float() + MATRIX[:, 3].float()
    torch.testing.assert_close(color(recolored_gaussians(gaussians, COLOR)), expected, atol=1e-5, rtol=1e-5)


def test_blocks_are_matched_from_the_middle_outwards() -> None:
    assert matching_order([(0, 1), (1, 2), (2, 3)]) == [(0, 1), (2, 1)]
    assert matching_order([(0, 1, 2), (1, 2, 3), (9, 8), (3, 8)]) == [(0, 1), (3, 1), (2, 3)]
    assert matching_order([(0, 1), (2, 3)]) == []
    assert matching_order([(0, 1)]) == []


def test_each_next_pair_shares_as_many_images_as_any_can() -> None:
    random = Random(0)
    blocks = [set(random.sample(range(60), 8)) for _ in range(30)] + [{100, 101}, {101, 102}]

    def most(done: set[int]) -> int:
        return max(len(blocks[one] & blocks[other]) for one in done for other in set(range(32)) - done)

    pairs = matching_order([sorted(block) for block in blocks])
    done = {pairs[0][1]}
    for block, reference in pairs:
        if reference not in done:
            assert most(done) == 0
            done.add(reference)
        assert block not in done
        assert len(blocks[block] & blocks[reference]) == most(done) > 0
        done.add(block)
    assert done == set(range(32))


def test_thousands_of_blocks_along_a_road_are_matched_one_after_the_other() -> None:
    """Time that grows with the cube of their number would never end."""
    count = 5_000
    assert matching_order([(number, number + 1) for number in range(count)]) == [
        (0, 1),
        *((number, number - 1) for number in range(2, count)),
    ]

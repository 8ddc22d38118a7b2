"""Structural similarity, the loss that is made of it, and their derivatives by the image."""

from functools import partial

import pytest
import torch

from nerfloom.kernels.images.ssim import photometric_loss, ssim
from tests.kernels.triton.compared import compare


@pytest.mark.parametrize("shape", [(11, 11, 1), (13, 17, 3)], ids=str)
def test_random_images(shape: tuple[int, ...]) -> None:
    torch.manual_seed(0)
    compare(ssim, {"image": torch.rand(shape), "target": torch.rand(shape)}, "image", tolerance=2e-5)
    loss = partial(photometric_loss, ssim_weight=0.2)
    compare(loss, {"image": torch.rand(shape), "target": torch.rand(shape)}, "image", tolerance=2e-5)
    given = {"image": torch.rand(shape), "target": torch.rand(shape), "weights": torch.rand(shape[:2])}
    compare(loss, given, "image", tolerance=2e-5)


def test_extremes() -> None:
    """The same image, black beside white, and values far outside [0, 1] with a similarity near 0."""
    torch.manual_seed(0)
    image = torch.rand(12, 11, 2)
    assert compare(ssim, {"image": image, "target": image})[0] == 1
    compare(ssim, {"image": torch.zeros(11, 11, 1), "target": torch.ones(11, 11, 1)}, "image", tolerance=1e-3)
    compare(ssim, {"image": 100 * image, "target": -image}, "image", tolerance=1e-3)


def test_a_target_with_a_gradient_is_the_references() -> None:
    given = {"image": torch.rand(11, 11, 1), "target": torch.rand(11, 11, 1)}
    compare(ssim, given, "target", expected="reference")

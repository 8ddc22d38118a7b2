"""The criterion of growth is the same on every backend: absolute gradients of their centres, against float64.

Triton's form: tests/kernels/triton/test_splats.py.
"""

from collections.abc import Callable
from typing import Any

import pytest
import torch

from nerfloom.kernels.dispatch import CPP
from nerfloom.kernels.splats.blend import BLEND, CHANNELS, Blended, blend_reference
from tests.kernels.compiled import needs_kernels
from tests.kernels.splat_truth import camera, growth_error, scene
from tests.kernels.test_few_operations import few

BOUND = 1e-5
COMPILED = next((each.run for each in BLEND.implementations if each.backend is CPP), blend_reference)
FORMS: dict[str, Any] = {"reference": blend_reference, "few operations": few(BLEND), "c++": COMPILED}


@pytest.mark.parametrize("name", ["reference", "few operations", pytest.param("c++", marks=needs_kernels)])
@pytest.mark.parametrize("size", [(37, 41), (60, 20)])
def test_growth_is_by_the_pixels_absolute_gradients(name: str, size: tuple[int, int]) -> None:
    torch.manual_seed(5)
    error = growth_error(FORMS[name], scene(80), camera(*size))
    print(f"{name}, {size}: relative error {error:.1e}")
    assert error < BOUND


@pytest.mark.parametrize("form", [blend_reference, few(BLEND)])
def test_growth_by_images_with_normals(form: Callable[..., Blended]) -> None:
    """No compiled form has the gradient of images with normals."""

    def with_normals(*given: Any) -> Blended:
        drawn = form(*given[:-2], CHANNELS["normals"], False)
        return drawn._replace(image=drawn.image[..., :4])

    torch.manual_seed(6)
    assert growth_error(with_normals, scene(60), camera(30, 33)) < BOUND

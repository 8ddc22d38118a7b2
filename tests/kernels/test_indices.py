"""Indices that come from outside are checked before a kernel reads where they say."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras
from nerfloom.data.pixels.batch import gather_colors
from nerfloom.fields.appearance import Appearance
from nerfloom.geometry.rays import Samples
from nerfloom.kernels.compositing.density import composite, distortion
from nerfloom.kernels.march.ray_order import sort_by_ray
from nerfloom.kernels.rows import gather_rows, take_rows

SIX = torch.full((2,), 6)
CAMERAS = Cameras(torch.eye(4)[:3].expand(2, 3, 4), *(torch.full((2,), 5.0) for _ in range(4)), SIX, SIX)
IN_TORCH = replace(CAMERAS, camera_to_worlds=CAMERAS.camera_to_worlds.double())
CALLS: dict[str, tuple[int, Callable[[Tensor], object]]] = {
    "rays of pixels": (72, lambda index: CAMERAS.pixel_rays(index, 0.0, 1.0)),
    "the same in torch": (72, lambda index: IN_TORCH.pixel_rays(index, 0.0, 1.0)),
    "colours": (
        9,
        lambda index: gather_colors(torch.zeros(9, 4, dtype=torch.uint8), index, torch.zeros(len(index), 3)),
    ),
    "rows in parts": (5, lambda index: gather_rows([[torch.zeros(2, 3), torch.zeros(3, 3)]], index)),
    "rows": (5, lambda index: take_rows(torch.zeros(5, 3), index)),
    "owners": (4, lambda index: sort_by_ray(index, torch.ones(len(index), dtype=torch.uint8), 4)),
    "photographs": (7, lambda index: Appearance(3, 7)(index, len(index))),
}
"""Functions that take indices, and the number of valid ones."""


@pytest.mark.parametrize("name", CALLS)
def test_an_index_that_is_not_there(name: str) -> None:
    count, call = CALLS[name]
    call(torch.tensor([0, count - 1]))
    call(torch.zeros(0, dtype=torch.int64))
    for wrong in (-1, count, 2**40, -(2**63), 2**63 - 1):
        with pytest.raises(IndexError):
            call(torch.tensor([0, wrong]))


def test_the_message_names_index_and_range() -> None:
    with pytest.raises(IndexError, match=r"pixels: index 72 .*72"):
        CAMERAS.pixel_rays(torch.tensor([3, 72]), 0.0, 1.0)


@pytest.mark.parametrize(
    "offsets", [[0, 5, 3, 6], [1, 2, 3, 6], [0, 2, 4, 5], [0, 2, 4, 7], [0, -1, 4, 6], [0, 2**40, 6], []]
)
def test_offsets_that_do_not_divide_the_samples(offsets: list[int]) -> None:
    values = torch.rand(6)
    samples = Samples(values, values + 1, torch.tensor(offsets, dtype=torch.int64))
    rays = max(len(offsets) - 1, 0)
    with pytest.raises(IndexError, match="offsets"):
        composite(samples, values, torch.rand(6, 3), torch.zeros(rays, 3), torch.ones(rays))
    with pytest.raises(IndexError, match="offsets"):
        distortion(values, samples)

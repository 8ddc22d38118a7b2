"""Batches: each ray goes through the pixel of its colour."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from scipy import stats
from torch import Tensor

from nerfloom.cameras.cameras import subpixels
from nerfloom.data.dataset import Dataset, load_dataset
from nerfloom.data.pixels.batch import (
    composite,
    draw_batch,
    draw_from_images,
    gather_colors,
    gather_colors_reference,
    view_colors,
    view_colors_reference,
)
from nerfloom.data.pixels.pixel_set import PixelSet
from nerfloom.dataparsers.blender import Blender
from tests.kernels.compiled import needs_kernels


@pytest.fixture
def dataset(shared_tiny: Path) -> Dataset:
    return load_dataset(Blender().parse(shared_tiny, "train"), "train")


def test_rays_and_colours_belong_together(dataset: Dataset) -> None:
    """Project each ray back into its camera, look the pixel up, and composite by hand."""
    torch.manual_seed(0)
    batch = draw_batch(dataset, 500, "random")
    assert batch.rays.camera_indices is not None
    cameras = dataset.cameras
    for ray in range(500):
        index = int(batch.rays.camera_indices[ray])
        local = cameras.camera_to_worlds[index][:, :3].T @ batch.rays.directions[ray]
        column = local[0] / -local[2] * cameras.fx[index] + cameras.cx[index] - 0.5
        row = -local[1] / -local[2] * cameras.fy[index] + cameras.cy[index] - 0.5
        assert abs(column - column.round()) < 1e-3
        rgba = dataset.image(index)[int(row.round()), int(column.round())].double() / 255
        expected = rgba[:3] * rgba[3] + batch.background[ray] * (1 - rgba[3])
        torch.testing.assert_close(batch.rgb[ray].double(), expected, atol=1e-6, rtol=0)
    assert batch.background.std() > 0.2


def test_pixels_are_drawn_evenly_and_by_the_seed(dataset: Dataset) -> None:
    torch.manual_seed(3)
    first = draw_batch(dataset, 20000, "white")
    torch.manual_seed(3)
    second = draw_batch(dataset, 20000, "white")
    torch.testing.assert_close(first.rgb, second.rgb, rtol=0, atol=0)
    assert first.rays.camera_indices is not None
    counts = torch.bincount(first.rays.camera_indices, minlength=len(dataset))
    assert stats.chisquare(counts.numpy()).pvalue > 1e-3
    assert bool((first.background == 1).all())


def test_images_of_different_sizes_share_one_buffer() -> None:
    from nerfloom.cameras.cameras import Cameras
    from nerfloom.data.scene import Scene

    sizes = torch.tensor([[4, 2], [3, 5]])
    pixels = torch.cat([torch.full((8, 3), 10), torch.full((15, 3), 200)]).to(torch.uint8)
    ones = torch.ones(2)
    cameras = Cameras(torch.eye(4)[:3].repeat(2, 1, 1), ones, ones, ones, ones, sizes[:, 0], sizes[:, 1])
    scene = Scene(torch.zeros(2, 3), 0, 1, 2, False, False, 5)
    data = Dataset(pixels, cameras, None, (Path("a"), Path("b")), scene, torch.eye(4)[:3], 1.0)
    assert data.image(0).shape == (2, 4, 3)
    assert data.image(1).shape == (5, 3, 3)
    torch.manual_seed(0)
    batch = draw_batch(data, 1000, "black")
    assert batch.alpha is None
    assert batch.rays.camera_indices is not None
    expected = torch.tensor([10.0, 200.0])[batch.rays.camera_indices] / 255
    torch.testing.assert_close(batch.rgb[:, 0], expected)


@pytest.mark.medium
def test_pixels_of_few_images_are_drawn_evenly(dataset: Dataset) -> None:
    """Each image as often as any other, and each of its pixels: of all pixels, and of some that are to be drawn."""
    some = PixelSet.of_runs(torch.tensor([5, 1203]), torch.tensor([295, 7]))  # of images 0 and 3 only
    for data, images in ((dataset, 10), (replace(dataset, drawn=some), 2), (replace(dataset, drawn=some.listed()), 2)):
        torch.manual_seed(0)
        drawn = [draw_from_images(data, 100, 2) for _ in range(1000)]
        assert all(bool((pixels.diff() >= 0).all()) for pixels in drawn)
        owners = [torch.unique(pixels // 400, return_counts=True) for pixels in drawn]
        assert {tuple(counts.tolist()) for _, counts in owners} == {(50, 50), (100,)}
        counts = torch.bincount(torch.cat([numbers.repeat(3 - len(numbers)) for numbers, _ in owners]), minlength=10)
        assert int((counts > 0).sum()) == images
        assert stats.chisquare(counts[counts > 0].numpy()).pvalue > 1e-3
        of_first = torch.bincount(torch.cat(drawn), minlength=4000)[:400]
        possible = torch.arange(400) if data.drawn is None else torch.arange(5, 300)
        assert int(of_first.sum() - of_first[possible].sum()) == 0
        assert stats.chisquare(of_first[possible].numpy()).pvalue > 1e-3


def test_some_pixels_of_a_batch_keep_what_belongs_to_them(dataset: Dataset) -> None:
    torch.manual_seed(0)
    batch = replace(draw_batch(dataset, 60, "random", subpixels=subpixels(4)), weights=torch.rand(60))
    assert batch.rays.camera_indices is not None
    chosen = batch.rays.camera_indices[::4] == 3
    part = batch[chosen]
    assert 0 < len(part) < 60
    assert part.rays_per_pixel == 4
    assert part.distances is None
    for name in ("pixels", "rgb", "background", "alpha", "weights"):
        assert torch.equal(getattr(part, name), getattr(batch, name)[chosen])
    assert torch.equal(part.rays.directions, batch.rays.directions.view(60, 4, 3)[chosen].view(-1, 3))


def test_compositing_of_opaque_images_changes_nothing() -> None:
    rgb = torch.rand(5, 3)
    assert composite(rgb, torch.rand(5, 3)) is rgb


@needs_kernels
@pytest.mark.parametrize("channels", [3, 4])
def test_compiled_and_torch_gather_the_same_colours(dataset: Dataset, channels: int) -> None:
    same = replace(dataset, pixels=dataset.pixels[:, :channels].contiguous())
    generator = torch.Generator().manual_seed(0)
    flat = torch.randint(len(same.pixels), (1000,), generator=generator)
    behind = torch.rand(1000, 3, generator=generator)
    one = gather_colors(same.pixels, flat, behind)
    two = gather_colors_reference(same.pixels, flat, behind)
    for mine, theirs in zip(one, two, strict=True):
        torch.testing.assert_close(mine, theirs)
    assert (one[1] is None) == (channels == 3)


@pytest.mark.parametrize("form", [pytest.param(view_colors, marks=needs_kernels), view_colors_reference])
@pytest.mark.parametrize("channels", [3, 4])
def test_a_whole_image_is_composited_pixel_by_pixel(
    form: Callable[..., tuple[Tensor, Tensor | None]], channels: int
) -> None:
    """All values of a byte, in an image larger than a thread's share."""
    generator = torch.Generator().manual_seed(0)
    pixels = torch.randint(256, (97, 190, channels), generator=generator).to(torch.uint8)
    pixels[0, :128] = torch.arange(256).to(torch.uint8).view(128, 2).repeat(1, 2)[:, :channels]
    behind = torch.tensor([0.25, 0.0, 1.0])
    rgb, alpha = form(pixels.transpose(0, 1).contiguous().transpose(0, 1), behind)
    shades = pixels.double() / 255
    cover = shades[..., 3:] if channels == 4 else torch.ones(97, 190, 1, dtype=torch.double)
    torch.testing.assert_close(rgb.double(), shades[..., :3] * cover + behind.double() * (1 - cover), atol=1e-6, rtol=0)
    assert (alpha is None) == (channels == 3)
    if alpha is not None:
        torch.testing.assert_close(alpha.double(), cover[..., 0], atol=1e-7, rtol=0)


def test_only_pixels_worth_drawing_are_drawn(dataset: Dataset) -> None:
    few = replace(dataset, drawn=PixelSet.of_runs(torch.tensor([5, 401]), torch.tensor([1, 2])))
    batch = draw_batch(few, 300, "white")
    assert batch.rays.camera_indices is not None
    assert set(batch.rays.camera_indices.tolist()) == {0, 1}
    assert len(batch.rays.directions.unique(dim=0)) == 3

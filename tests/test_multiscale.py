"""Images at several sizes: their pixels and cameras, their weights, and their metrics."""

import math
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.data.dataset import Dataset, load_dataset
from nerfloom.data.pixels.batch import gather_batch
from nerfloom.data.pixels.cache import PixelMemory
from nerfloom.data.sources import PixelSource, Request
from nerfloom.dataparsers.blender import Blender
from nerfloom.evaluation.evaluator import Evaluation, evaluate
from nerfloom.scene.silhouettes import Silhouettes
from tests.training.helpers import tiny_trainer

SIZES = (20, 10, 5, 2)
"""Sides of the tiny set's images: whole, 1/2, 1/4, and 1/8 without the remainder."""


def loaded(folder: Path, split: str = "train", memory: PixelMemory | None = None) -> Dataset:
    return load_dataset(Blender(multiscale=4).parse(folder, split), split, memory)  # type: ignore[arg-type]


def images_of(data: Dataset, reduction: int) -> list[int]:
    assert data.reductions is not None
    return [index for index, found in enumerate(data.reductions.tolist()) if found == reduction]


def test_each_image_is_there_at_each_size(shared_tiny: Path) -> None:
    data, plain = loaded(shared_tiny), load_dataset(Blender().parse(shared_tiny, "train"), "train")
    count = len(plain)
    assert len(data) == 4 * count
    assert [tuple(data.image(i).shape[:2]) for i in range(0, 4 * count, count)] == [(side, side) for side in SIZES]
    assert data.names == plain.names * 4
    assert data.scene.image_size == plain.scene.image_size == 20
    for index in range(count):
        assert torch.equal(data.image(index), plain.image(index))
        torch.testing.assert_close(
            data.cameras.camera_to_worlds[index::count], plain.cameras.camera_to_worlds[[index] * 4]
        )


def test_small_images_are_means_of_premultiplied_pixels(shared_tiny: Path) -> None:
    """Alpha agrees to half a step of 8 bits, and colour too where alpha shows it."""
    data = loaded(shared_tiny)
    for reduction in (2, 4, 8):
        for place, index in enumerate(images_of(data, reduction)):
            side = 20 // reduction
            whole = data.image(place)[: side * reduction, : side * reduction].double() / 255
            blocks = torch.cat([whole[..., :3] * whole[..., 3:], whole[..., 3:]], -1)
            truth = blocks.view(side, reduction, side, reduction, 4).mean((1, 3))
            found = data.image(index).double() / 255
            torch.testing.assert_close(found[..., 3], truth[..., 3], atol=0.5 / 255 + 1e-9, rtol=0)
            torch.testing.assert_close(found[..., :3] * found[..., 3:], truth[..., :3], atol=1.5 / 255, rtol=0)


def test_cameras_see_the_same_points_at_the_same_share_of_their_images(shared_tiny: Path) -> None:
    """Pixel centres are at 0.5: a point's column c + 0.5 is halved with the size."""
    data = loaded(shared_tiny)
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    for reduction in (2, 4, 8):
        for place, index in enumerate(images_of(data, reduction)):
            large, small = (data.cameras.project(points, camera) for camera in (place, index))
            for axis in (0, 1):
                torch.testing.assert_close((small[axis] + 0.5) * reduction, large[axis] + 0.5, atol=1e-3, rtol=1e-4)


def test_cones_are_as_wide_as_pixels(shared_tiny: Path) -> None:
    """Mip-NeRF's radius in the middle of an image, 2 / sqrt(12) of a pixel at distance 1, against its edges."""
    data = loaded(shared_tiny)
    for reduction in (1, 2, 4, 8):
        index = images_of(data, reduction)[0]
        middle = data.cameras.cx[index] - 0.5
        rays = data.cameras.rays(
            torch.tensor([index] * 3), middle + torch.tensor([-0.5, 0.0, 0.5]), middle.expand(3), 0, 1
        )
        assert rays.pixel_radii is not None
        on_plane = rays.directions / (rays.directions * -data.cameras.camera_to_worlds[index, :, 2]).sum(
            -1, keepdim=True
        )
        width = (on_plane[2] - on_plane[0]).norm().item()
        assert width == pytest.approx(2 * math.tan(0.35) * reduction / 20, rel=1e-4)  # a side of the field of view
        assert rays.pixel_radii[1].item() == pytest.approx(width * 2 / 12**0.5, rel=1e-4)


def test_pixels_weigh_by_their_area_and_one_in_the_mean(shared_tiny: Path) -> None:
    data = loaded(shared_tiny)
    every = torch.arange(len(data.pixels))
    weights = gather_batch(data, every, torch.ones(len(every), 3)).weights
    assert weights is not None
    assert weights.mean().item() == pytest.approx(1.0, abs=1e-5)
    first = [weights[data.cameras.ends[images_of(data, s)[0]]].item() for s in (1, 2, 4, 8)]
    assert [value / first[0] for value in first] == pytest.approx([1, 4, 16, 64])
    assert (
        gather_batch(load_dataset(Blender().parse(shared_tiny, "train"), "train"), every[:3], torch.ones(3, 3)).weights
        is None
    )


@pytest.mark.parametrize("per_pixel", [1, 4])
def test_batches_have_the_weights_of_their_pixels(shared_tiny: Path, per_pixel: int) -> None:
    data = loaded(shared_tiny)
    torch.manual_seed(0)
    source = PixelSource(data, "white", 0)
    batch = source.draw(Request(0, 500, per_pixel))
    plain = gather_batch(data, batch.pixels, torch.ones(500, 3)).weights
    assert batch.weights is not None
    assert plain is not None
    torch.testing.assert_close(batch.weights, plain)


def test_pixels_from_a_file_are_those_from_memory(shared_tiny: Path, tmp_path: Path) -> None:
    data = loaded(shared_tiny)
    for _ in range(2):  # written, then found
        cached = loaded(shared_tiny, memory=PixelMemory.of(0, tmp_path))
        assert cached.mapped is not None
        assert torch.equal(cached.pixels, data.pixels)
        assert cached.reductions is not None
        assert data.reductions is not None
        assert torch.equal(cached.reductions, data.reductions)
    assert len(list(tmp_path.iterdir())) == 1
    load_dataset(Blender().parse(shared_tiny, "train"), "train", PixelMemory.of(0, tmp_path))
    assert len(list(tmp_path.iterdir())) == 2  # of one size: another file


def test_an_unreadable_image_is_left_out_at_every_size(tiny: Path) -> None:
    (tiny / "train" / "r_3.png").write_bytes(b"no image")
    data = loaded(tiny)
    assert data.reductions is not None
    assert data.reductions.bincount().tolist() == [0, 9, 9, 0, 9, 0, 0, 0, 9]
    assert "r_3.png" not in data.names
    assert data.cameras.widths.tolist() == [side for side in SIZES for _ in range(9)]


def test_silhouettes_are_those_of_whole_images(tiny: Path) -> None:
    """One faint pixel is rounded away in small images, which must not empty the space that it shows."""
    image = np.zeros((20, 20, 4), np.uint8)
    image[8, 8] = 255, 0, 0, 20
    iio.imwrite(tiny / "train" / "r_0.png", image)
    data = loaded(tiny)
    assert data.image(30)[..., 3].max() == 0
    assert Silhouettes.of(data).at_full_size == list(range(10))


@pytest.mark.parametrize("scales", [0, -1, 9])
def test_impossible_numbers_of_sizes_are_refused(shared_tiny: Path, scales: int) -> None:
    with pytest.raises(DataError, match=f"--multiscale is {scales}; it must be from 1 to 8"):
        Blender(multiscale=scales).parse(shared_tiny, "train")


def test_images_that_are_too_small_are_refused(shared_tiny: Path) -> None:
    with pytest.raises(DataError, match="has none left"):
        load_dataset(Blender(multiscale=6).parse(shared_tiny, "train"), "train")


def test_a_run_learns_from_all_sizes_and_reports_each(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run")
    data = loaded(shared_tiny, "val")
    trainer = type(trainer)(trainer.method, trainer.config, loaded(shared_tiny), data)
    for _ in range(3):
        assert all(map(math.isfinite, trainer.train_step().losses.values()))
    found: Evaluation = evaluate(trainer.model, data)
    by_size = found.results["by_size"]
    assert list(by_size) == ["1", "1/2", "1/4", "1/8"]
    for size, reduction in zip(by_size, (1, 2, 4, 8), strict=True):
        rows = [row["psnr"] for row in found.per_image if row["reduction"] == reduction]
        assert by_size[size]["psnr"] == pytest.approx(np.mean(rows))
    assert found.results["psnr"] == pytest.approx(np.mean([each["psnr"] for each in by_size.values()]))
    assert f"(1: {by_size['1']['psnr']:.2f}, 1/2: {by_size['1/2']['psnr']:.2f}, " in found.line()
    assert by_size["1/8"]["ssim"] is None  # 2 pixels
    plain = evaluate(trainer.model, replace(data, reductions=None))
    assert "by_size" not in plain.results
    assert "(1:" not in plain.line()

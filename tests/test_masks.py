"""Masks: ignored pixels are neither drawn, nor judged, nor taken for empty."""

from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from PIL import Image

from nerfloom.base.errors import DataError
from nerfloom.data.dataset import Dataset, load_dataset
from nerfloom.data.masks import read_mask
from nerfloom.data.pixels.batch import composite, draw_batch
from nerfloom.data.pixels.cache import PixelMemory
from nerfloom.data.pixels.pixel_set import PixelSet
from nerfloom.dataparsers.blender import Blender
from nerfloom.evaluation.evaluator import evaluate
from nerfloom.evaluation.metrics import psnr, ssim
from nerfloom.scene.profile import SceneProfile
from nerfloom.scene.silhouettes import Silhouettes
from nerfloom.training.trainer import Trainer
from tests.images import parsed, write_mask, write_noise
from tests.training.helpers import tiny_run, tiny_trainer

SIZES = [(30, 20), (12, 40), (25, 25)]


@pytest.fixture
def used() -> list[np.ndarray]:
    """(H, W) bool of two of the three images; the other has no mask."""
    generator = np.random.default_rng(0)
    return [generator.random((height, width)) < 0.6 for width, height in SIZES[:2]]


@pytest.fixture(params=[0.0, 1e9], ids=["file", "memory"])
def masked(tmp_path: Path, used: list[np.ndarray], request: pytest.FixtureRequest) -> Dataset:
    scene = write_noise(tmp_path / "images", SIZES)
    masks = [write_mask(tmp_path / f"{index}.png", mask) for index, mask in enumerate(used)]
    scene = parsed(list(scene.image_paths), SIZES, [*masks, None])
    memory = PixelMemory(request.param, tmp_path / "cache")
    load_dataset(scene, "train", memory)
    return load_dataset(scene, "train", memory)  # where it is cached, masks come from the file


def test_only_what_masks_leave_is_drawn(masked: Dataset, used: list[np.ndarray]) -> None:
    expected = torch.from_numpy(np.concatenate([mask.reshape(-1) for mask in used] + [np.ones(625, bool)]))
    assert masked.kept is not None
    assert torch.equal(masked.kept.mask(0, len(expected)), expected)
    drawn = draw_batch(masked, 20_000, "black").pixels
    assert bool(expected[drawn].all())
    assert len(drawn.unique()) == expected.sum()
    kept = masked.kept_of(1)
    assert kept is not None
    assert np.array_equal(kept.numpy(), used[1])
    profile = SceneProfile.of(masked, [])
    assert profile.ignored == pytest.approx(1 - expected.float().mean().item(), abs=1e-6)
    assert f"{profile.ignored:.0%} of pixels ignored" in profile.lines()[0]


def test_silhouettes_and_masks_are_combined(masked: Dataset) -> None:
    some = torch.arange(len(masked.pixels)) % 3 == 0
    drawn = masked.drawing(PixelSet.of_mask(some)).drawn
    assert drawn is not None
    assert masked.kept is not None
    assert torch.equal(drawn.mask(0, len(some)), masked.kept.mask(0, len(some)) & some)
    nothing = PixelSet.of_mask(torch.zeros_like(some))
    assert masked.drawing(nothing).drawn is masked.drawn  # rather than to draw from nothing


def test_grey_is_split_in_the_middle_and_colour_modes_do_not_matter(tmp_path: Path) -> None:
    grey = np.array([[0, 127, 128, 255]], np.uint8)
    iio.imwrite(tmp_path / "grey.png", grey)
    iio.imwrite(tmp_path / "rgb.png", np.repeat(grey[..., None], 3, -1))
    for name in ("grey.png", "rgb.png"):
        assert read_mask(tmp_path / name, 4, 1).tolist() == [[False, False, True, True]]


def test_masks_as_programs_of_segmentation_write_them(tmp_path: Path) -> None:
    used = np.random.default_rng(0).random((6, 5)) < 0.5
    white = np.full((6, 5), 255, np.uint8)
    grey = np.where(used, 255, 0).astype(np.uint8)
    Image.fromarray(used.astype(np.uint8)).save(tmp_path / "labels.png")  # 0 and 1
    Image.fromarray(np.dstack([white, white, white, grey])).save(tmp_path / "cutout.png")  # white, or transparent
    Image.fromarray(grey).convert("LA").save(tmp_path / "opaque.png")
    Image.fromarray(used).save(tmp_path / "bits.png")
    for name in ("labels.png", "cutout.png", "opaque.png", "bits.png"):
        assert np.array_equal(read_mask(tmp_path / name, 5, 6), used), name
    Image.fromarray(0 * grey).save(tmp_path / "black.png")
    assert not read_mask(tmp_path / "black.png", 5, 6).any()


@pytest.mark.parametrize("factor", [2, 3])
def test_masks_of_other_sizes_take_the_nearest(tmp_path: Path, factor: int) -> None:
    small = np.random.default_rng(1).random((11, 7)) < 0.5
    large = small.repeat(factor, 0).repeat(factor, 1)
    assert np.array_equal(read_mask(write_mask(tmp_path / "large.png", large), 7, 11), small)
    assert np.array_equal(read_mask(write_mask(tmp_path / "small.png", small), 7 * factor, 11 * factor), large)
    rest = np.pad(large, ((0, factor - 1), (0, 1)))  # cut off when the photograph was reduced
    assert np.array_equal(read_mask(write_mask(tmp_path / "rest.png", rest), 7, 11), small)


def test_a_mask_that_cannot_be_used_is_named(tmp_path: Path) -> None:
    scene = write_noise(tmp_path / "images", SIZES)
    (tmp_path / "broken.png").write_bytes(b"no image")
    wide = write_mask(tmp_path / "wide.png", np.ones((20, 45), bool))
    black = [write_mask(tmp_path / f"black{i}.png", np.zeros((h, w), bool)) for i, (w, h) in enumerate(SIZES)]
    for masks, message in (
        ([tmp_path / "none.png", None, None], r"mask .*none\.png does not exist"),
        ([tmp_path / "broken.png", None, None], r"mask .*broken\.png is not a readable image"),
        ([wide, None, None], r"mask .*wide\.png is 45x20 pixels, but its image is 30x20"),
        (black, "masks of split 'train' keep no pixel"),
    ):
        with pytest.raises(DataError, match=message):
            load_dataset(parsed(list(scene.image_paths), SIZES, masks), "train")


def test_masks_that_ignore_nothing_change_nothing(tmp_path: Path) -> None:
    scene = write_noise(tmp_path / "images", SIZES[:1])
    mask = write_mask(tmp_path / "white.png", np.ones((20, 30), bool))
    data = load_dataset(parsed(list(scene.image_paths), SIZES[:1], [mask]), "train")
    assert data.kept is None
    assert data.drawn is None


def test_an_image_without_mask_that_is_skipped_takes_its_mask_along(tmp_path: Path) -> None:
    scene = write_noise(tmp_path / "images", SIZES)
    used = [np.random.default_rng(i).random((h, w)) < 0.5 for i, (w, h) in enumerate(SIZES)]
    masks = [write_mask(tmp_path / f"{i}.png", mask) for i, mask in enumerate(used)]
    scene.image_paths[1].write_bytes(b"no image")
    data = load_dataset(parsed(list(scene.image_paths), SIZES, list(masks)), "train")
    kept = data.kept_of(1)
    assert kept is not None
    assert np.array_equal(kept.numpy(), used[2])


def test_ignored_pixels_do_not_count_in_evaluation(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", evaluated=True)
    data, model = trainer.eval_set, trainer.model
    assert data is not None
    plain = evaluate(model, data)
    mask = torch.rand(len(data.pixels)) < 0.7
    mask[: len(mask) // len(data)] = False  # of the first photograph nothing is left
    some = replace(data, kept=PixelSet.of_mask(mask))
    changed = some.pixels.clone()
    changed[~mask] = 77  # any value there
    found, same = evaluate(model, some), evaluate(model, replace(some, pixels=changed))
    assert [row["name"] for row in found.per_image] == list(data.names[1:])
    assert found.results["psnr"] == same.results["psnr"]
    assert found.results["psnr"] != plain.results["psnr"]
    background = model.background
    target = composite(data.image(1).float() / 255, background)
    rgb = model.render_view(data.view(1), background).rgb.clamp(0, 1)
    kept = some.kept_of(1)
    assert kept is not None
    assert found.per_image[0]["psnr"] == pytest.approx(psnr(rgb[kept], target[kept]), abs=1e-4)
    assert found.per_image[0]["pixels"] == int(kept.sum())
    assert found.results["num_pixels"] == int(mask.sum())
    assert found.results["num_ignored_pixels"] == mask[data.cameras.offsets[1] :].numel() - int(mask.sum())
    assert found.results["ssim"] is None  # 30 % of the pixels of every window are ignored
    assert found.results["ssim_images"] == 0
    assert "masks ignore 30%)" in found.line()
    assert found.masks_note is not None
    assert f"{len(data) - 1} of {len(data) - 1} images have no ssim" in found.masks_note


def test_similarity_is_of_windows_of_kept_pixels(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", evaluated=True)
    data, model = trainer.eval_set, trainer.model
    assert data is not None
    height, width = int(data.cameras.heights[0]), int(data.cameras.widths[0])
    kept = torch.ones(len(data), height, width, dtype=torch.bool)
    kept[0, :3, : width - 2] = False
    found = evaluate(model, replace(data, kept=PixelSet.of_mask(kept.reshape(-1))), max_images=1)
    background = model.background
    rgb = model.render_view(data.view(0), background).rgb.clamp(0, 1)
    target = composite(data.image(0).float() / 255, background)
    assert found.per_image[0]["ssim"] == pytest.approx(ssim(rgb[3:], target[3:]), abs=1e-6)
    assert (found.results["ssim_images"], found.results["num_ignored_pixels"]) == (1, 3 * (width - 2))
    assert evaluate(model, data, max_images=1).masks_note is None


def test_what_is_ignored_is_not_taken_for_empty(shared_tiny: Path, tmp_path: Path) -> None:
    data = load_dataset(Blender().parse(shared_tiny, "train"), "train")
    height, width = int(data.cameras.heights[0]), int(data.cameras.widths[0])
    half = torch.zeros(len(data), height, width, dtype=torch.bool)
    half[:, :, : width // 2] = True
    masked = replace(data, kept=PixelSet.of_mask(half), drawn=PixelSet.of_mask(half))
    sums = Silhouettes.of(masked).sums[0]
    opaque = (data.image(0)[..., 3] > 0) | ~half[0]
    assert int(sums[-1, -1]) == int(opaque.sum())
    trainer = Trainer.of(tiny_run("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=3), masked)
    trainer.train_step()
    drawn = trainer.train_set.drawn
    assert drawn is not None
    assert not bool((drawn.mask(0, half.numel()) & ~half.reshape(-1)).any())


@pytest.mark.parametrize("channels", [3, 4])
def test_masks_that_cut_out_are_alpha(tmp_path: Path, used: list[np.ndarray], channels: int) -> None:
    """They equal images with the masks as fourth channel, in whole images and in batches."""
    scene = write_noise(tmp_path / "images", SIZES, channels, ".png")
    masks = [write_mask(tmp_path / f"{index}.png", mask) for index, mask in enumerate(used)]
    scene = parsed(list(scene.image_paths), SIZES, [*masks, None])
    with_alpha = []
    for path, mask in zip(scene.image_paths, [*used, np.ones((25, 25), bool)], strict=True):
        image = iio.imread(path)
        alpha = np.where(mask, image[..., 3] if channels == 4 else 255, 0).astype(np.uint8)
        iio.imwrite(tmp_path / path.name, np.dstack([image[..., :3], alpha]))
        with_alpha.append(tmp_path / path.name)
    found = load_dataset(scene, "train", masks="empty")
    expected = load_dataset(parsed(with_alpha, SIZES), "train")
    assert found.scene.has_alpha
    assert found.kept is None
    assert found.drawn is None
    assert SceneProfile.of(found, []).transparent == SceneProfile.of(expected, []).transparent
    for index in range(3):
        assert torch.equal(found.image(index), expected.image(index))
    batches = []
    for dataset in (found, expected):
        torch.manual_seed(0)
        batches.append(draw_batch(dataset, 5_000, "random"))
    assert torch.equal(batches[0].pixels, batches[1].pixels)
    torch.testing.assert_close(batches[0].rgb, batches[1].rgb)
    assert batches[0].alpha is not None
    torch.testing.assert_close(batches[0].alpha, batches[1].alpha)


def test_masks_cut_out_if_they_take_most_and_from_each_photograph_other_pixels(tmp_path: Path) -> None:
    size = (20, 20)
    scene = write_noise(tmp_path / "images", [size] * 3)
    rim = np.zeros((20, 20), bool)
    rim[5:15, 5:15] = True
    moved, most = np.roll(rim, 2, axis=1), np.ones((20, 20), bool)
    most[:5] = False

    def opaque(name: str, used: list[np.ndarray]) -> bool:
        masks = [write_mask(tmp_path / f"{name}{index}.png", mask) for index, mask in enumerate(used)]
        dataset = load_dataset(parsed(list(scene.image_paths), [size] * 3, list(masks)), "train", masks="auto")
        assert (dataset.opaque is None) != (dataset.kept is None)
        return dataset.opaque is not None

    assert opaque("object", [rim, moved, rim])
    assert not opaque("lens", [rim, rim, rim])
    assert not opaque("people", [most, most, np.roll(most, 5, axis=0)])

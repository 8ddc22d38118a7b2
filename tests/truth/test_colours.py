"""Colours and opacity from the file to the batch and to the judged images: straight alpha, multiplied once."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from nerfloom.data.dataset import Dataset, load_dataset
from nerfloom.data.pixels.batch import gather_batch, gather_colors_reference
from nerfloom.dataparsers.blender import Blender
from nerfloom.evaluation.evaluator import evaluate
from nerfloom.training.datasets import load_split
from nerfloom.training.run import Run
from tests.test_nerfacto import captured
from tests.training.helpers import tiny_run, tiny_trainer
from tests.truth.ball import pose_of

SIZE = 12


def glass() -> np.ndarray:
    """(SIZE, SIZE, 4) uint8: every opacity beside every other, and colours where nothing is to be seen."""
    random = np.random.default_rng(0)
    alpha = random.choice([0, 51, 102, 204, 255], (SIZE, SIZE, 1))
    return np.concatenate([random.integers(0, 256, (SIZE, SIZE, 3)), alpha], -1).astype(np.uint8)


def reduced(factor: int) -> np.ndarray:
    """(h, w, 4) in [0, 1]: means over blocks, of colours weighted by opacity."""
    rgba = glass() / 255
    blocks = rgba.reshape(SIZE // factor, factor, SIZE // factor, factor, 4)
    alpha = blocks[..., 3:].mean((1, 3))
    return np.concatenate([(blocks[..., :3] * blocks[..., 3:]).mean((1, 3)) / np.maximum(alpha, 1e-9), alpha], -1)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two views, which are all splits."""
    frames = []
    for index in range(2):
        Image.fromarray(glass()).save(tmp_path / f"{index}.png")
        frames.append({"file_path": str(index), "transform_matrix": pose_of(index).tolist()})
    for split in ("train", "val", "test"):
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 0.6, "frames": frames}))
    return tmp_path


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_stored_colours_are_straight_and_a_batch_shows_them_over_its_background(factor: int, folder: Path) -> None:
    data = load_dataset(Blender(downscale_factor=factor).parse(folder, "train"), "train")
    truth = reduced(factor)
    seen = truth[..., 3] > 0
    stored = data.image(1).double().numpy() / 255
    np.testing.assert_allclose(stored[..., 3], truth[..., 3], atol=0.51 / 255)
    np.testing.assert_allclose(stored[seen][:, :3], truth[seen][:, :3], atol=0.51 / 255)
    pixels = data.cameras.image_pixels(1)
    behind = torch.rand(len(pixels), 3, generator=torch.Generator().manual_seed(0))
    batch = gather_batch(data, pixels, behind)
    flat = truth.reshape(-1, 4)
    expected = flat[:, :3] * flat[:, 3:] + behind.numpy() * (1 - flat[:, 3:])
    for rgb, alpha in ((batch.rgb, batch.alpha), gather_colors_reference(data.pixels, pixels, behind)):
        assert alpha is not None
        np.testing.assert_allclose(rgb.numpy(), expected, atol=1.1 / 255)
        np.testing.assert_allclose(alpha.numpy(), flat[:, 3], atol=0.51 / 255)


def test_a_photograph_with_alpha_is_judged_over_white_and_one_without_over_black(
    shared_tiny: Path, tmp_path: Path
) -> None:
    """The background is the one of training, or the given one."""
    for has_alpha, asked, expected in (
        (True, "auto", 1.0),
        (False, "auto", 0.0),
        (True, "black", 0.0),
        (False, "white", 1.0),
    ):
        trainer = captured(shared_tiny, tmp_path / f"{has_alpha} {asked}", {"has_alpha": has_alpha}, background=asked)
        assert trainer.model.background.tolist() == [expected] * 3
        trained_over = asked if asked != "auto" else {True: "random", False: "black"}[has_alpha]
        assert trainer.source.background == trained_over


def test_what_is_judged_of_a_photograph_with_alpha_is_how_it_looks_over_white(folder: Path, tmp_path: Path) -> None:
    """A model that shows nothing shows the background: its error is white paper's."""
    trainer = tiny_trainer("instant-ngp", folder, tmp_path / "run", silhouette_cells=False, sampler="occupancy")
    trainer.model.sampler.carve(torch.zeros_like(trainer.model.sampler.occupied))
    found = evaluate(trainer.model, trainer.train_set)
    rgba = glass() / 255
    error = ((1 - (rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:])) ** 2).mean()
    assert found.results["psnr"] == pytest.approx(-10 * np.log10(error), abs=1e-3)
    assert found.results["ssim"] is not None


def cut_out(tiny: Path, grey: int = 255) -> Path:
    """The tiny ball as a capture with masks that cut it out, and with opaque photographs."""
    names = []
    for file in sorted(tiny.rglob("*.png")):
        rgba = np.asarray(Image.open(file))
        rgb = np.where(rgba[..., 3:] > 0, rgba[..., :3], grey).astype(np.uint8)
        (tiny / "images").mkdir(exist_ok=True)
        (tiny / "masks").mkdir(exist_ok=True)
        name = f"{file.parent.name}_{file.name}"
        Image.fromarray(rgb).save(tiny / "images" / name)
        mask = rgba[..., 3].copy()
        mask[: 6 + len(names) % 3] = 0  # seen from everywhere alike, the ball alone might be the rim of a lens
        Image.fromarray(mask).save(tiny / "masks" / name)
        names.append((name, file))
    frames = []
    for name, file in names:
        listed = json.loads((tiny / f"transforms_{file.parent.name}.json").read_text())["frames"]
        pose = listed[int(file.stem.removeprefix("r_"))]["transform_matrix"]
        frames.append({"file_path": f"images/{name}", "mask_path": f"masks/{name}", "transform_matrix": pose})
    content = {"camera_angle_x": 0.7, "frames": frames}
    for file in tiny.glob("transforms_*.json"):
        file.unlink()
    (tiny / "transforms.json").write_text(json.dumps(content))
    return tiny


@pytest.fixture
def run(tiny: Path, tmp_path: Path) -> Run:
    """A run of instant-ngp on the cut-out ball."""
    from nerfloom.dataparsers.nerfstudio import Nerfstudio

    made = tiny_run("instant-ngp", cut_out(tiny), tmp_path / "run")
    return replace(made, dataparser="nerfstudio", parser=Nerfstudio())


def shown(data: Dataset) -> Any:
    """A batch of every pixel, over grey."""
    pixels = torch.arange(int(data.cameras.offsets[-1]))
    return gather_batch(data, pixels, torch.full((len(pixels), 3), 0.25))


def test_masks_that_cut_an_object_out_mean_emptiness_in_training_and_nothing_in_evaluation(run: Run) -> None:
    train, test = load_split(run, "train"), load_split(run, "test")
    kept = torch.cat([torch.from_numpy(_mask(run, name)) for name in train.names])
    assert 0.1 < kept.double().mean() < 0.5
    batch = shown(train)
    assert torch.equal(batch.alpha, kept.float())
    assert bool((batch.rgb[~kept] == 0.25).all())
    assert not bool((batch.rgb[kept] == 0.25).all(-1).any())
    assert train.kept is None
    assert train.drawn is None
    # For any meaning of masks in training, evaluation uses the pixels that they keep, in opaque photographs.
    assert (test.opaque, test.scene.has_alpha) == (None, False)
    for index, name in enumerate(test.names):
        judged = test.kept_of(index)
        assert judged is not None
        assert torch.equal(judged.view(-1), torch.from_numpy(_mask(run, name)))


def test_masks_that_hide_little_say_nothing_of_what_is_there(run: Run) -> None:
    assert run.config.data is not None
    for file in (run.config.data / "masks").iterdir():
        mask = np.full_like(np.asarray(Image.open(file)), 255)
        mask[: 3 + len(file.name) % 3 + int(file.stem[-1]) % 2] = 0
        Image.fromarray(mask).save(file)
    train = load_split(run, "train")
    assert train.opaque is None
    assert not train.scene.has_alpha
    assert train.drawn is not None
    expected = np.concatenate([_mask(run, name) for name in train.names])
    assert torch.equal(train.drawn.pixels(), torch.from_numpy(expected).nonzero().squeeze(-1))


def _mask(run: Run, name: str) -> np.ndarray:
    """(H * W,) bool."""
    assert run.config.data is not None
    return np.asarray(Image.open(run.config.data / "masks" / name)).reshape(-1) >= 128

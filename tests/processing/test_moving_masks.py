"""Masks of moving things, in files that data formats read."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest

from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.data.dataset import Dataset, load_dataset
from nerfloom.data.pixels.left_out import LeftOutTiles
from nerfloom.processing.kinds import KINDS
from nerfloom.processing.moving_masks import mask_moving
from nerfloom.processing.settings import ImagesFlags
from nerfloom.registry import load_dataparser
from tests.processing.scene import FOCAL, HEIGHT, WIDTH, photograph, pose_at, texture


def write_folder(folder: Path, images: dict[str, np.ndarray], poses: list[np.ndarray]) -> None:
    """A data folder in nerfstudio's format, of images by name."""
    for name, pixels in images.items():
        (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        iio.imwrite(folder / "images" / name, pixels)
    placed = zip(images, poses, strict=True)
    frames = [{"file_path": f"images/{name}", "transform_matrix": pose.tolist()} for name, pose in placed]
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    content = {"camera_model": "PINHOLE", **lens, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))


def write_corner(folder: Path, count: int) -> None:
    """Photographs of a corner, with a box at another place in each."""
    textures, random = [texture(seed) for seed in range(3)], np.random.default_rng(0)
    images, poses = dict[str, np.ndarray](), list[np.ndarray]()
    for index in range(count):
        pose = pose_at(0.25 + 1.05 * index / count, 1.0 + 0.8 * (index % 2))
        pixels = np.array(photograph(pose, textures, 1))
        row, column = random.integers(20, HEIGHT - 110), random.integers(20, WIDTH - 80)
        pixels[row : row + 90, column : column + 60] = random.integers(0, 255, 3)
        images[f"{index:02d}.png"] = pixels
        poses.append(pose)
    write_folder(folder, images, poses)


@pytest.mark.slow
def test_what_moves_is_masked_in_files_that_the_format_reads(tmp_path: Path) -> None:
    """The files and their names; how good masks are takes longer runs to judge."""
    write_corner(tmp_path / "data", 16)
    small: dict[str, Any] = {
        "max_num_iterations": 250,
        "log2_table_size": 14,
        "num_rays_per_batch": 1024,
    }
    mask_moving(tmp_path / "data", 1, **small)
    parsed = load_dataparser("nerfstudio")().parse(tmp_path / "data", "train")
    assert parsed.mask_paths is not None
    dataset = load_dataset(parsed, "train")
    kept = [dataset.kept_of(index) for index in range(len(dataset))]
    shares = [float((~each).float().mean()) for each in kept if each is not None]
    assert len(shares) == len(dataset)
    assert 0 < max(shares) < 0.8
    assert (tmp_path / "data" / "masks_2" / "00.png.png").is_file()


def test_an_image_that_cannot_be_read_has_no_mask_and_all_others_have_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Images in two folders have the same names. What moves is told by its grey level."""
    names = ["a/0.png", "a/1.png", "b/0.png", "b/1.png"]
    images = {name: np.full((HEIGHT, WIDTH, 3), 60 * place, np.uint8) for place, name in enumerate(names)}
    write_folder(tmp_path, images, [pose_at(0.25 + 0.25 * place, 1.0) for place in range(4)])
    (tmp_path / "images" / names[0]).write_text("no image")

    def found(train: object, dataset: Dataset, tiles: LeftOutTiles, config: object, **settings: object) -> None:
        for index in range(len(dataset)):
            tiles.tiles.of_image(tiles.state, index).fill_(float(dataset.image(index)[0, 0, 0] == 120))

    monkeypatch.setattr("nerfloom.processing.moving_masks.scout", found)
    mask_moving(tmp_path, 0)
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    assert [frame.get("mask_path") for frame in frames] == [None, *(f"masks/{name}.png" for name in names[1:])]
    levels = [np.unique(iio.imread(tmp_path / "masks" / f"{name}.png")).tolist() for name in names[1:]]
    assert levels == [[255], [0], [255]]


def test_a_run_that_was_stopped_before_its_masks_goes_on_with_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Poses are finished then, so nothing else is done again; without --mask-moving nothing is done."""
    made = list[Any]()
    monkeypatch.setattr("nerfloom.processing.colmap.require", lambda: None)
    monkeypatch.setattr(
        "nerfloom.processing.moving_masks.mask_moving", lambda *given, **settings: made.append((*given, settings))
    )
    finished = tmp_path / "out" / "transforms.json"
    finished.parent.mkdir()
    finished.write_text(json.dumps({"frames": [{"file_path": "images/a.png"}]}))
    flags = ImagesFlags(data=tmp_path, output_dir=tmp_path / "out", resume=True, mask_seconds=7, num_downscales=2)
    with_masks = dataclasses.replace(flags, mask_moving=True)
    KINDS["images"].write(flags)
    assert made == []
    KINDS["images"].write(with_masks)
    assert made == [(tmp_path / "out", 2, {"max_seconds": 7})]
    finished.write_text(json.dumps({"frames": [{"file_path": "images/a.png", "mask_path": "masks/a.png.png"}]}))
    KINDS["images"].write(with_masks)
    assert len(made) == 1


def test_flags_that_exclude_each_other(tmp_path: Path) -> None:
    flags = ImagesFlags(data=tmp_path, output_dir=tmp_path / "out", masks_dir=tmp_path, mask_moving=True)
    with pytest.raises(ConfigError, match="--masks-dir with --mask-moving"):
        flags.check()
    with pytest.raises(FlagError, match="--mask-seconds is 0"):
        dataclasses.replace(flags, mask_seconds=0).check()

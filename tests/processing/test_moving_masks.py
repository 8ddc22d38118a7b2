"""Masks of moving things, in files that data formats read."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest

from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.data.dataset import load_dataset
from nerfloom.processing.kinds import KINDS
from nerfloom.processing.moving_masks import mask_moving
from nerfloom.processing.settings import ImagesFlags
from nerfloom.registry import load_dataparser
from tests.processing.scene import FOCAL, HEIGHT, WIDTH, photograph, pose_at, texture


def write_folder(folder: Path, count: int) -> None:
    """Photographs of a corner, in nerfstudio's format, with a box at another place in each."""
    (folder / "images").mkdir(parents=True)
    textures, random = [texture(seed) for seed in range(3)], np.random.default_rng(0)
    frames: list[dict[str, Any]] = []
    for index in range(count):
        pose = pose_at(0.25 + 1.05 * index / count, 1.0 + 0.8 * (index % 2))
        pixels = np.array(photograph(pose, textures, 1))
        row, column = random.integers(20, HEIGHT - 110), random.integers(20, WIDTH - 80)
        pixels[row : row + 90, column : column + 60] = random.integers(0, 255, 3)
        iio.imwrite(folder / "images" / f"{index:02d}.png", pixels)
        frames.append({"file_path": f"images/{index:02d}.png", "transform_matrix": pose.tolist()})
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    content = {"camera_model": "PINHOLE", **lens, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))


@pytest.mark.slow
def test_what_moves_is_masked_in_files_that_the_format_reads(tmp_path: Path) -> None:
    """The files and their names; how good masks are takes longer runs to judge."""
    write_folder(tmp_path / "data", 16)
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

"""A few of the training images: which, and that everything else about a scene stays."""

from pathlib import Path

import numpy as np
import pytest
import torch

from nerfloom.base.errors import ConfigError
from nerfloom.base.evenly_spaced import evenly_spread
from nerfloom.data.training_images import chosen_images
from nerfloom.dataparsers.nerfstudio import Nerfstudio
from nerfloom.training.datasets import load_split
from tests.dataparsers.captures import write_capture
from tests.training.helpers import tiny_run


@pytest.mark.parametrize("total", [1, 2, 7, 17, 18, 37, 50, 100])
@pytest.mark.parametrize("count", [1, 2, 3, 6, 8, 9])
def test_images_are_spread_as_regnerf_and_freenerf_spread_them(total: int, count: int) -> None:
    expected = [round(place) for place in np.linspace(0, total - 1, count)] if count < total else list(range(total))
    assert evenly_spread(total, count) == expected


def test_three_of_ferns_17_training_images() -> None:
    """Every eighth of 20 photographs is held out; the published protocol takes these of the other 17."""
    assert evenly_spread(17, 3) == [0, 8, 16]


def test_the_eight_views_of_blender_scenes_are_numpys_first_choice() -> None:
    """DietNeRF's and FreeNeRF's programs draw them with numpy's seed 0; --train-image-indices selects them."""
    drawn = np.random.RandomState(0).choice(np.arange(100), size=8, replace=False)
    assert drawn.tolist() == [26, 86, 2, 55, 75, 93, 16, 73]


def test_a_run_learns_from_the_images_that_are_asked_for(shared_tiny: Path, tmp_path: Path) -> None:
    every = load_split(tiny_run("instant-ngp", shared_tiny, tmp_path), "train")
    some = load_split(tiny_run("instant-ngp", shared_tiny, tmp_path, max_train_images=3), "train")
    listed = load_split(tiny_run("instant-ngp", shared_tiny, tmp_path, train_image_indices=(7, 2)), "train")
    assert some.names == tuple(every.names[index] for index in (0, 4, 9))
    assert listed.names == (every.names[7], every.names[2])
    assert torch.equal(listed.image(1), every.image(2))
    assert torch.equal(listed.scene.camera_to_worlds[0], every.scene.camera_to_worlds[7])  # type: ignore[index]
    assert (some.scene.num_cameras, listed.scene.num_cameras) == (3, 2)


def test_held_out_images_stay_and_no_scene_is_placed_anew(tmp_path: Path) -> None:
    folder = write_capture(tmp_path / "capture")
    every = Nerfstudio().parse(folder, "train")
    run = tiny_run("instant-ngp", folder, tmp_path, max_train_images=2)
    run = type(run)(run.method, run.config, "nerfstudio", Nerfstudio(), run.folder)
    assert run.parse("test").image_paths == Nerfstudio().parse(folder, "test").image_paths
    two = run.parse("train")
    assert two.image_paths == (every.image_paths[0], every.image_paths[-1])
    assert torch.equal(two.transform, every.transform)  # type: ignore[arg-type]
    assert (two.scale, two.near) == (every.scale, every.near)


@pytest.mark.parametrize("indices", [(1, 1), (0, 99), (-1,)])
def test_images_that_are_not_there_are_named(indices: tuple[int, ...], tmp_path: Path) -> None:
    parsed = Nerfstudio().parse(write_capture(tmp_path / "capture"), "train")
    with pytest.raises(ConfigError, match=r"--train-image-indices: -?\d+ must be from 0 to \d+ and be given once$"):
        chosen_images(parsed, None, indices)


def test_a_number_and_a_list_do_not_go_together(tmp_path: Path) -> None:
    parsed = Nerfstudio().parse(write_capture(tmp_path / "capture"), "train")
    with pytest.raises(ConfigError, match="leave out --max-train-images"):
        chosen_images(parsed, 1, (0,))

"""The colour behind what is transparent in training: random where nothing may be transparent, or alpha says where."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from nerfloom import Scene
from nerfloom.data.pixels.batch import training_background
from nerfloom.dataparsers.procedural import Procedural

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
OUTSIDE, INSIDE = (0.0, 0.0, 4.0), (0.0, 0.5, -0.5)


def seen_from(*positions: tuple[float, float, float]) -> Scene:
    poses = torch.eye(3, 4).repeat(len(positions), 1, 1)
    poses[:, :, 3] = torch.tensor(positions)
    return Scene(BOX, 0.1, 10.0, len(positions), has_alpha=False, moving=False, image_size=8, camera_to_worlds=poses)


@pytest.mark.parametrize(
    ("positions", "inside"), [([OUTSIDE], False), ([OUTSIDE, INSIDE], True), ([(0.9, 0.9, 1.1)], False)]
)
def test_it_is_random_if_cameras_stand_in_the_box(positions: list[tuple[float, float, float]], inside: bool) -> None:
    scene = seen_from(*positions)
    assert scene.ends_in_box is inside
    assert training_background("auto", scene) == ("random" if inside else "black")
    assert training_background("white", scene) == "white"


@pytest.mark.parametrize("facts", [{"unbounded": True}, {"warped": True}, {"camera_to_worlds": None}])
def test_rays_may_leave_other_scenes(facts: dict[str, object]) -> None:
    scene = replace(seen_from(INSIDE), **facts)  # type: ignore[arg-type]
    assert not scene.ends_in_box
    assert training_background("auto", scene) == "black"


def test_alpha_says_where_nothing_is() -> None:
    scene = replace(seen_from(INSIDE), has_alpha=True)
    assert not scene.ends_in_box
    assert training_background("auto", scene) == "random"


def test_rays_end_in_the_courtyard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NERFLOOM_CACHE", str(tmp_path))
    parsed = Procedural(courtyard=True, size=8, num_train=4).parse(None, "train")
    centres = parsed.cameras.camera_to_worlds[..., 3]
    assert bool(((centres > parsed.box[0]) & (centres < parsed.box[1])).all())

"""Values out of checkpoints: each of its field's type, or refused by name."""

from dataclasses import asdict
from typing import Any

import pytest
import torch

from nerfloom.base.checked import checked
from nerfloom.data.scene import Scene
from nerfloom.training.state import State

BOX = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])
POSES = torch.eye(4)[:3].repeat(5, 1, 1)
SCENE = Scene(BOX, 0.1, 6, 5, True, False, 64, poses="device", camera_to_worlds=POSES)
STATE = State(step=7, seconds=1.5, rays=100, curve=((0.5, 3, 20.0), (1.0, 5, 21.0)))


def test_what_was_written_is_read() -> None:
    assert checked(State, vars(STATE)) == STATE
    assert checked(State, {}) == State()
    found = Scene.of(vars(SCENE))
    assert asdict(found).keys() == asdict(SCENE).keys()
    assert found.box is BOX
    assert Scene.of({**vars(SCENE), "camera_to_worlds": None}).camera_to_worlds is None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"step": "7"}, "State.step is '7'"),
        ({"step": True}, "State.step is True"),
        ({"seconds": None}, "State.seconds is None"),
        ({"curve": [(0.5, 3, 20.0)]}, "State.curve is "),
        ({"curve": ((0.5, 3),)}, "State.curve is "),
        ({"curve": ((0.5, 3.5, 20.0),)}, "State.curve is "),
        ({"steps": 3}, "unexpected keyword argument 'steps'"),
        ({7: 3}, "keywords must be strings"),
    ],
)
def test_states_of_other_kinds_are_refused(changes: dict[Any, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        checked(State, {**vars(STATE), **changes})


@pytest.mark.parametrize("values", [None, [1], "state", 3])
def test_what_is_no_dictionary_is_refused(values: Any) -> None:
    with pytest.raises(ValueError, match="State is "):
        checked(State, values)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"box": BOX[0]}, r"box has shape \(3,\)"),
        ({"box": BOX.to_sparse()}, "box"),
        ({"box": BOX.long()}, "box"),
        ({"box": "cube"}, "Scene.box is 'cube'"),
        ({"box": BOX * torch.nan}, "empty or too large"),
        ({"box": BOX * 1e38}, "empty or too large"),
        ({"box": 0 * BOX}, "empty or too large"),
        ({"far": 0.0}, "far 0.0"),
        ({"near": float("nan")}, "near nan"),
        ({"image_size": 2**62}, "images of 4611686018427387904 pixels"),
        ({"near": "0"}, "Scene.near is '0'"),
        ({"moving": 1}, "Scene.moving is 1"),
        ({"poses": "guessed"}, "Scene.poses is 'guessed'"),
        ({"poses": BOX}, "Scene.poses is "),
        ({"num_cameras": 6}, "number of cameras, 6, does not match"),
        ({"num_cameras": 10**12, "camera_to_worlds": None}, "number of cameras, 1000000000000"),
        ({"camera_to_worlds": POSES[:, :2]}, "number of cameras, 5, does not match"),
        ({"exposures": torch.zeros(4)}, "exposures do not match"),
        ({"exposures": torch.zeros(5).long()}, "exposures do not match"),
        ({"exposures": torch.full((5,), torch.nan)}, "exposures do not match"),
        ({"exposures": torch.full((5,), 1e6)}, "or are out of range"),
        ({"devices": torch.zeros(5)}, "devices do not match"),
        ({"devices": torch.tensor([0, 0, 5, 0, 0])}, "devices do not match"),
        ({"devices": torch.tensor([0, 0, -1, 0, 0])}, "devices do not match"),
    ],
)
def test_scenes_that_cannot_be_are_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Scene.of({**vars(SCENE), **changes})

"""Figures computed from measurements, against values worked out by hand."""

import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from benchmarks import cache, contention, pose_refinement, poses, processes
from benchmarks.children import output_of
from nerfloom.base.errors import ConfigError, DataError, NerfloomError
from nerfloom.cameras.cameras import Cameras
from nerfloom.data.dataset import load_dataset
from nerfloom.registry import load_dataparser
from tests.dataparsers.sparse_models import Capture, make_capture, write_colmap


def test_a_curve_meets_the_target_between_its_points() -> None:
    curve = [(0.0, 0.0), (10.0, 20.0), (20.0, 30.0), (30.0, 28.0), (40.0, 34.0)]
    assert processes.crossing(curve, 25.0) == pytest.approx(15.0)
    assert processes.crossing(curve, 29.0) == pytest.approx(19.0)  # the first time
    assert processes.crossing(curve, 34.0) == pytest.approx(40.0)
    assert processes.crossing(curve, 34.1) is None


def test_the_fair_share_is_that_of_threads_over_cores() -> None:
    shares = {row.name: row.fair_share(2) for row in contention.ROWS}
    assert shares["nothing"] == shares["nothing, one thread"] == 1.0
    assert shares["one loop"] == pytest.approx(2 / 3)
    assert shares["two loops"] == shares["the same once more"] == shares["two loops in a session of their own"] == 0.5
    assert 0.98 < shares["two loops, nice 19"] < 1.0


def test_conditions_are_selected_by_parts_of_names_and_running_alone_is_always_among_them() -> None:
    assert contention.chosen([]) == list(contention.ROWS)
    assert [row.name for row in contention.chosen(["two loops"])] == [
        "nothing",
        "two loops, nice 19",
        "two loops",
        "two loops in a session of their own",
    ]
    with pytest.raises(ConfigError, match="'three loops'"):
        contention.chosen(["two loops", "three loops"])


def test_a_process_that_fails_says_why() -> None:
    assert output_of([sys.executable, "-c", "print('so'); print('much')"]) == "so\nmuch\n"
    with pytest.raises(NerfloomError, match=r"failed: nothing to train on$"):
        output_of([sys.executable, "-c", "import sys; sys.exit('loading\\nnothing to train on')"])
    with pytest.raises(NerfloomError, match="exit status 3"):
        output_of([sys.executable, "-c", "raise SystemExit(3)"])


def some_cameras(count: int) -> Cameras:
    draws = torch.Generator().manual_seed(0)
    q, _ = torch.linalg.qr(torch.randn(count, 3, 3, generator=draws))
    q = q * torch.linalg.det(q)[:, None, None]
    centres = torch.randn(count, 3, 1, generator=draws)
    one, size = torch.full((count,), 30.0), torch.full((count,), 20)
    return Cameras(torch.cat([q, centres], -1), one, one, one, one, size, size)


def test_cameras_are_disturbed_by_the_angle_and_the_share_asked_for() -> None:
    cameras = some_cameras(20)
    disturbed = pose_refinement.disturb(cameras, degrees=2.0, share=0.05)
    before, after = cameras.camera_to_worlds, disturbed.camera_to_worlds
    turns = after[:, :, :3] @ before[:, :, :3].transpose(1, 2)
    cosines = (turns.diagonal(dim1=1, dim2=2).sum(-1) - 1) / 2
    torch.testing.assert_close(
        torch.rad2deg(cosines.double().acos()), torch.full((20,), 2.0).double(), atol=0.02, rtol=0
    )
    moves = (after[:, :, 3] - before[:, :, 3]).norm(dim=-1) / before[:, :, 3].norm(dim=-1)
    torch.testing.assert_close(moves, torch.full((20,), 0.05))


@pytest.mark.medium
@pytest.mark.parametrize("method", ["nerfacto", "zip-nerf"])
def test_poses_of_an_object_in_a_box_are_refined(method: str, shared_tiny: Path) -> None:
    data = load_dataset(load_dataparser("blender")().parse(shared_tiny, "train"), "train")
    trainer = pose_refinement.trained(method, data, 0.5, "SO3xR3")
    assert trainer.model.poses is not None
    assert bool((trainer.model.poses.tangents != 0).any())


def test_cameras_are_carried_into_the_frame_of_other_poses() -> None:
    cameras, truth = some_cameras(5), some_cameras(12).camera_to_worlds.double()
    turn, shift = some_cameras(1).camera_to_worlds[0, :, :3].double(), torch.tensor([[1.0], [-2.0], [3.0]])

    def moved(given: torch.Tensor) -> torch.Tensor:
        given = given.double()
        return torch.cat([turn @ given[:, :, :3], 2.5 * turn @ given[:, :, 3:] + shift], -1)

    carried = pose_refinement.carry(cameras, truth, moved(truth))
    torch.testing.assert_close(carried.camera_to_worlds, moved(cameras.camera_to_worlds).float())


def write_processed(folder: Path, capture: Capture, names: list[str]) -> Path:
    """A transforms.json with the true poses of some images, in another frame and another unit."""
    half = math.sqrt(0.5)
    turn = np.array([[half, -half, 0], [half, half, 0], [0, 0, 1]])
    frames = []
    for name in names:
        at = capture.names.index(name)
        rotation, translation = capture.rotations[at], capture.translations[at]
        pose = np.eye(4)
        pose[:3, :3] = turn @ rotation.T @ np.diag([1, -1, -1])
        pose[:3, 3] = 3 * turn @ (-rotation.T @ translation) + [1, 2, 3]
        frames.append({"file_path": f"images/{name}", "transform_matrix": pose.tolist()})
    folder.mkdir()
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    return folder


def test_poses_are_compared_by_name_up_to_a_similarity(tmp_path: Path) -> None:
    capture = make_capture()
    model = write_colmap(tmp_path / "model", capture)
    found = poses.compare(write_processed(tmp_path / "all", capture, capture.names[2:][::-1]), model)
    assert (found["registered"], found["given"]) == (8, 10)
    assert found["largest_angle_degrees"] < 1e-4
    assert found["largest_center_relative_to_extent"] < 1e-9
    assert found["processing"] is None
    others = make_capture(seed=1)
    others.names = [f"other{name}" for name in others.names]
    with pytest.raises(DataError, match="no common images"):
        poses.compare(write_processed(tmp_path / "none", others, others.names), model)


def test_enlarged_renders_keep_their_vertical_field_of_view(tmp_path: Path) -> None:
    source = tmp_path / "renders"
    (source / "train").mkdir(parents=True)
    render = np.zeros((10, 10, 4), dtype=np.uint8)
    render[:, :] = (200, 100, 50, 255)
    render[:, 5:] = 0
    Image.fromarray(render).save(source / "train" / "r_0.png")
    frame = {"file_path": "./train/r_0", "transform_matrix": np.eye(4).tolist()}
    (source / "transforms_train.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": [frame]}))
    cache.enlarge(source, tmp_path / "large", 80, 40)
    content = json.loads((tmp_path / "large" / "transforms_train.json").read_text())
    focal = 0.5 * 80 / math.tan(content["camera_angle_x"] / 2)
    assert 2 * math.atan(0.5 * 40 / focal) == pytest.approx(0.7)  # of the square render, both angles are 0.7
    image = np.asarray(Image.open(tmp_path / "large" / content["frames"][0]["file_path"])).astype(int)
    assert image.shape == (40, 80, 3)
    assert np.abs(image[20, 28] - (200, 100, 50)).max() < 12  # the render's left half, in the middle of the image
    assert image[20, [8, 52, 72]].max() < 12  # beside the render, and where it is transparent: black


def test_seconds_of_calls_add_up() -> None:
    spent = [0.0]
    double = cache.timed_into(lambda x: 2 * x, spent)
    assert [double(1), double(2)] == [2, 4]
    assert 0 < spent[0] < 1

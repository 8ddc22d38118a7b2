"""ns-process-data from end to end."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from benchmarks.pose_errors import pose_errors
from nerfloom.cli.process_data import main
from nerfloom.processing.kinds import process
from nerfloom.processing.settings import Record3DFlags
from tests.conftest import Refused
from tests.processing.scene import write_corner


def test_bad_input_is_refused_in_a_line(tmp_path: Path, refused: Refused) -> None:
    output = ("--output-dir", tmp_path / "out")
    assert "unknown kind 'image'" in refused(main, "image")
    assert "no such file or folder" in refused(main, "images", "--data", tmp_path / "none", *output)
    (tmp_path / "empty").mkdir()
    assert "has no image" in refused(main, "images", "--data", tmp_path / "empty", *output)
    few = ("images", "--data", tmp_path / "empty", *output, "--num-downscales", -1)
    assert "must be from 0 to 8" in refused(main, *few, status=2)
    assert "is not an export of Record3D" in refused(main, "record3d", "--data", tmp_path / "empty", *output)
    assert not (tmp_path / "out" / "transforms.json").exists()


def test_record3d_keeps_the_phones_poses(tmp_path: Path) -> None:
    root = tmp_path / "EXR_RGBD"
    (root / "rgb").mkdir(parents=True)
    for index in (0, 2, 3):
        Image.new("RGB", (8, 6)).save(root / "rgb" / f"{index}.jpg")
    half = 0.5**0.5
    poses = [[0, 0, half, half, index, 2.0, 3.0] for index in range(4)]
    matrix = [10.0, 0, 0, 0, 11.0, 0, 4.0, 3.0, 1.0]
    (root / "metadata.json").write_text(json.dumps({"w": 8, "h": 6, "K": matrix, "poses": poses}))
    output = tmp_path / "out"
    process("record3d", Record3DFlags(data=tmp_path, output_dir=output, num_downscales=1))
    found = json.loads((output / "transforms.json").read_text())
    assert (found["fl_x"], found["fl_y"], found["cx"], found["cy"]) == (10, 11, 4, 3)
    # The phone's z, x and y become x, y and z.
    assert [frame["transform_matrix"][1][3] for frame in found["frames"]] == [0, 2, 3]
    quarter_turn = np.array(found["frames"][0]["transform_matrix"])[:3, :3]
    np.testing.assert_allclose(quarter_turn, [[0, 0, 1], [0, -1, 0], [1, 0, 0]], atol=1e-9)
    with Image.open(output / "images_2" / "0.jpg") as small:
        assert small.size == (4, 3)


@pytest.mark.slow
def test_poses_of_photographs_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pycolmap")
    given = write_corner(tmp_path / "photographs")
    (tmp_path / "photographs" / "broken.jpg").write_text("no image")
    output = tmp_path / "out"
    arguments = [
        "images",
        "--data",
        tmp_path / "photographs",
        "--output-dir",
        output,
        "--camera-model",
        "SIMPLE_PINHOLE",
    ]
    monkeypatch.setattr("sys.argv", ["ns-process-data", *map(str, arguments)])
    main()
    content = json.loads((output / "transforms.json").read_text())
    found = {frame["source_path"]: np.array(frame["transform_matrix"]) for frame in content["frames"]}
    assert len(found) >= 18
    names = sorted(found)
    pairs = [torch.from_numpy(np.stack([poses[name] for name in names])) for poses in (found, given)]
    errors = pose_errors(*pairs)
    print("median angle, degrees:", errors.median_angle, "median centre error:", errors.median_distance)
    assert errors.median_angle < 1
    assert errors.median_distance < 0.02
    assert abs(content["fl_x"] / 300 - 1) < 0.1
    summary = json.loads((output / "colmap" / "summary.json").read_text())
    assert summary["unreadable"] == 1
    for folder in ("images", "images_2", "images_4", "images_8", "colmap/sparse/0"):
        assert any((output / folder).iterdir())
    assert not (output / "colmap" / "unfinished").exists()


@pytest.mark.slow
def test_a_stopped_run_keeps_features_and_matches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pycolmap")
    write_corner(tmp_path / "photographs", 8)
    output = tmp_path / "out"
    words = ["images", "--data", tmp_path / "photographs", "--output-dir", output, "--num-downscales", 0]

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as stopped:
        stopped.setattr("sys.argv", ["ns-process-data", *map(str, words)])
        stopped.setattr("nerfloom.processing.mapping.reconstruct", stop)
        with pytest.raises(SystemExit):
            main()
    assert "--resume" in " ".join(capsys.readouterr().err.split())
    monkeypatch.setattr("sys.argv", ["ns-process-data", *map(str, words), "--resume"])
    main()
    said = " ".join(capsys.readouterr().err.split())
    assert "8 images by 1 camera, 8 reused" in said
    assert "28 of 28 pairs, 28 of them reused" in said
    assert len(json.loads((output / "transforms.json").read_text())["frames"]) >= 6
    main()
    assert "nothing to resume: it is finished" in " ".join(capsys.readouterr().err.split())

"""Git LFS pointers in place of files, as after a clone without Git LFS."""

from collections.abc import Callable
from pathlib import Path

import pytest

from nerfloom.base.errors import DataError
from nerfloom.base.json_files import read_json
from nerfloom.data.image_files import image_size, read_image
from nerfloom.data.ply import read_points
from nerfloom.dataparsers.colmap_files import check_binary, check_text
from nerfloom.splats.files import read_gaussians

POINTER = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 12345\n"


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("1.jpg", read_image),
        ("1.jpg", lambda file: image_size([file])),
        ("points.ply", read_points),
        ("scene.ply", read_gaussians),
        ("scene.spz", read_gaussians),
        ("cameras.bin", lambda file: check_binary(file.parent)),
        ("cameras.txt", lambda file: check_text(file.parent)),
        ("transforms.json", read_json),
    ],
)
def test_a_pointer_is_called_one(tmp_path: Path, name: str, read: Callable[[Path], object]) -> None:
    (tmp_path / name).write_text(POINTER)
    with pytest.raises(DataError, match=rf"{name}.* it is a Git LFS pointer; run git lfs pull"):
        read(tmp_path / name)

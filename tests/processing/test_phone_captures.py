"""Phones' captures with something wrong in them: refused in one line that names the file, and nothing is written."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from nerfloom.base.errors import DataError
from nerfloom.processing import polycam, record3d
from tests.dataparsers.test_polycam import STAMPS, write_polycam
from tests.dataparsers.test_record3d import write_record3d

Content = dict[str, Any]


def spoil(file: Path, change: Callable[[Content], Any] | str) -> None:
    """Change a JSON file's content, or put a text in its place."""
    content = json.loads(file.read_text())
    if isinstance(change, str):
        file.write_text(change)
    else:
        change(content)
        file.write_text(json.dumps(content))


CAMERAS = {
    "deep": "[" * 100_000,
    "a list": "[]",
    "nan pose": lambda c: c.update(t_03=math.nan),
    "huge pose": lambda c: c.update(t_03=10**400),
    "no pose": lambda c: c.pop("t_12"),
    "nan centre": lambda c: c.update(cx=math.nan),
    "no focal length": lambda c: c.update(fx=0.0),
    "endless width": lambda c: c.update(width=math.inf),
    "wide": lambda c: c.update(width=1e300),
    "blur is a word": lambda c: c.update(blur_score="sharp"),
    "blur is nothing": lambda c: c.update(blur_score=None),
}
METADATA = {
    "deep": "[" * 100_000,
    "a list": "[]",
    "nan pose": lambda c: c["poses"][4].__setitem__(5, math.nan),
    "huge pose": lambda c: c["poses"][4].__setitem__(5, 10**400),
    "no rotation": lambda c: c["poses"].__setitem__(4, [0] * 7),
    "a rotation whose square overflows": lambda c: c["poses"].__setitem__(4, [1e200] * 7),
    "nan matrix": lambda c: c["K"].__setitem__(6, math.nan),
    "no focal length": lambda c: c["K"].__setitem__(0, 0),
    "endless width": lambda c: c.update(w=math.inf),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_polycam(name: str, tmp_path: Path) -> None:
    folder = write_polycam(tmp_path / "room")
    file = folder / "keyframes" / "cameras" / f"{STAMPS[4]}.json"
    spoil(file, CAMERAS[name])
    with pytest.raises(DataError, match="000.jpg" if name == "wide" else file.name):
        polycam.convert(folder, tmp_path / "out", 0, 100, 25.0, 0)
    assert not (tmp_path / "out" / "transforms.json").exists()


@pytest.mark.parametrize("name", METADATA)
def test_record3d(name: str, tmp_path: Path) -> None:
    folder = write_record3d(tmp_path / "recording")
    spoil(folder / "EXR_RGBD" / "metadata.json", METADATA[name])
    with pytest.raises(DataError, match=r"metadata\.json"):
        record3d.convert(folder, tmp_path / "out", 0, 100)
    assert not (tmp_path / "out").exists()

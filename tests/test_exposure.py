"""How photographs were taken: exposures in stops, and the device, as their files state them."""

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from PIL.TiffImagePlugin import IFDRational
from rich.console import Console

from nerfloom.base import console
from nerfloom.base.errors import DataError
from nerfloom.cameras.cameras import Cameras
from nerfloom.data.dataset import load_dataset
from nerfloom.data.exposure import (
    DETAILS,
    F_NUMBER,
    ISO,
    MAKER,
    MODEL,
    SECONDS,
    Taken,
    devices_of,
    exposures_of,
    read_taken,
)
from nerfloom.dataparsers.nerfstudio import Nerfstudio
from tests.dataparsers.captures import write_capture


def write(path: Path, details: dict[int, Any] | None, device: tuple[str, str] | None = ("Maker", "Model")) -> Path:
    """Write a photograph with EXIF, or without if there are no details."""
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    if device is not None:
        exif[MAKER], exif[MODEL] = device
    if details is not None:
        exif[DETAILS] = details
    Image.fromarray(np.zeros((6, 8, 3), np.uint8)).save(path, **({} if details is None else {"exif": exif.tobytes()}))
    return path


def shot(seconds: float, f_number: float, iso: int) -> dict[int, Any]:
    return {SECONDS: IFDRational(1, round(1 / seconds)), F_NUMBER: IFDRational(round(10 * f_number), 10), ISO: iso}


def test_exposures_are_read_in_stops(tmp_path: Path) -> None:
    """Twice the time or sensitivity is a stop more; an f-number of 2.8 instead of 2 is a stop less."""
    settings = shot(1 / 50, 2.0, 100), shot(1 / 25, 2.0, 100), shot(1 / 50, 2.0, 400), shot(1 / 50, 2.8, 100)
    files = [write(tmp_path / f"{index}{ending}", each) for index, (each, ending) in
             enumerate(zip(settings, (".jpg", ".JPG", ".png", ".webp"), strict=True))]  # fmt: skip
    taken = read_taken(files)
    assert {each.device for each in taken} == {"Maker Model"}
    stops = [each.stops - taken[0].stops for each in taken]
    assert stops == pytest.approx([0, 1, 2, -2 * math.log2(1.4)], abs=1e-6)
    assert taken[0].stops == pytest.approx(math.log2(1 / 50 * 100 / 4))
    found = exposures_of(taken)
    assert found is not None
    assert found.tolist() == pytest.approx([s - sum(stops) / 4 for s in stops], abs=1e-6)


def test_progress_is_shown_while_exposures_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Console(force_terminal=True, width=120, record=True, stderr=True, _environ={})
    monkeypatch.setattr(console, "console", terminal)
    assert read_taken([tmp_path / "missing.jpg"] * 3) == (Taken(),) * 3
    assert "Reading exposures" in terminal.export_text()


def test_what_is_missing_or_damaged_is_unknown(tmp_path: Path) -> None:
    """A missing exposure is no error: only pixels count."""
    files = [
        write(tmp_path / "none.jpg", None),
        write(tmp_path / "none.png", None),
        write(tmp_path / "zero.jpg", {SECONDS: IFDRational(0, 1), F_NUMBER: IFDRational(2, 1), ISO: 100}),
        write(tmp_path / "manual.jpg", {SECONDS: IFDRational(1, 50), ISO: 100}),
        tmp_path / "missing.jpg",
    ]
    whole = write(tmp_path / "whole.jpg", shot(1 / 50, 2.0, 100)).read_bytes()
    start = whole.index(b"Exif")
    for index in range(20):
        damaged = bytearray(whole)
        damaged[start + 6 + 7 * index] ^= 0xFF
        files.append(tmp_path / f"damaged{index}.jpg")
        files[-1].write_bytes(damaged)
    (tmp_path / "text.jpg").write_text("no image")
    taken = read_taken([*files, tmp_path / "text.jpg"])
    assert [math.isnan(each.stops) for each in (*taken[:5], taken[-1])] == [True] * 6
    assert [each.device for each in taken[:5]] == ["", "", "Maker Model", "Maker Model", ""]
    for numbers in ((math.inf, 2.0, 100.0), (0.01, math.nan, 100.0), (0.01, 2.0, -1.0), (0.0, 2.0, 100.0)):
        assert math.isnan(Taken.of(*numbers).stops)


def test_unknown_and_impossible_exposures_count_as_the_mean() -> None:
    assert exposures_of(None) is None
    assert exposures_of([Taken(), Taken()]) is None
    assert exposures_of([Taken(3.0), Taken(3.0)]) is None
    found = exposures_of([Taken(3.0), Taken(), Taken(5.0), Taken(900.0)])
    assert found is not None
    assert found.tolist() == [-1.0, 0.0, 1.0, 0.0]


def test_devices_are_told_by_name_or_lens() -> None:
    ones, sides = torch.ones(4), torch.full((4,), 8)
    lengths = torch.tensor([5.0, 6, 5, 5])
    cameras = Cameras(torch.eye(4)[:3].expand(4, 3, 4), lengths, 5 * ones, ones, ones, sides, sides)
    named = [Taken(device=name) for name in ("b", "a", "b", "a")]
    found = devices_of(named, cameras)
    assert found is not None
    assert found.tolist() == [1, 0, 1, 0]
    for taken in (None, [*named[:3], Taken()]):
        by_lens = devices_of(taken, cameras)
        assert by_lens is not None
        assert by_lens.tolist() == [0, 1, 0, 0]
    assert devices_of([named[0]] * 4, cameras) is None
    assert devices_of(None, dataclasses.replace(cameras, fx=ones)) is None


# -- captures ---------------------------------------------------------------------------------------------------------


def edited(folder: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    file = folder / "transforms.json"
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))
    return folder


def stated(content: dict[str, Any]) -> None:
    content["f_number"] = 2.0
    for index, frame in enumerate(content["frames"]):
        frame.update(exposure_time=0.01 * 2**index, iso=100)


def test_a_transforms_file_states_exposures(tmp_path: Path) -> None:
    folder = edited(write_capture(tmp_path / "capture", 6), stated)
    scene = Nerfstudio(eval_interval=0).parse(folder, "train")
    found = load_dataset(scene, "train").scene.exposures
    assert found is not None
    assert found.tolist() == pytest.approx([-2.5, -1.5, -0.5, 0.5, 1.5, 2.5], abs=1e-5)
    edited(folder, lambda content: content["frames"][2].update(exposure_time=-1))
    with pytest.raises(DataError, match=r"frame 2: 'exposure_time' is -1; it must be a number above zero"):
        Nerfstudio().parse(folder, "train")
    edited(folder, lambda content: [frame.pop("exposure_time") for frame in content["frames"]])
    assert Nerfstudio().parse(folder, "train").taken is None


def test_reduced_images_have_the_exposures_of_their_originals(tmp_path: Path) -> None:
    """The program that wrote the copies has left it out."""
    folder = write_capture(tmp_path / "capture", 6)
    names = sorted(path.name for path in (folder / "images").iterdir())
    for index, name in enumerate(names):
        with Image.open(folder / "images" / name) as image:
            image.load()
        exif = Image.Exif()
        exif[DETAILS] = shot(1 / 50, 2.0, 100 * 2**index)
        image.save(folder / "images" / name, exif=exif.tobytes())
        small = folder / "images_2" / name
        small.parent.mkdir(exist_ok=True)
        image.reduce(2).save(small)
    scene = Nerfstudio(eval_interval=0, downscale_factor=2).parse(folder, "train")
    assert {path.parent.name for path in scene.image_paths} == {"images_2"}
    for parsed in (scene, Nerfstudio(eval_interval=0).parse(folder, "train")):
        found = load_dataset(parsed, "train").scene.exposures
        assert found is not None
        assert found.tolist() == pytest.approx([-2.5, -1.5, -0.5, 0.5, 1.5, 2.5], abs=1e-5)

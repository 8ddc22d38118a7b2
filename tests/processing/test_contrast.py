"""Photographs that use a small part of their range."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nerfloom.base.errors import DataError
from nerfloom.processing.brightness import stretched, tones
from nerfloom.processing.contrast import for_features
from nerfloom.processing.images import prepare_all


def ramp(low: float, high: float) -> np.ndarray:
    return np.linspace(low, high, 101)[None].repeat(50, 0)


@pytest.mark.parametrize(("top", "kind"), [(255, np.uint8), (65535, np.uint16)])
def test_the_range_is_found_and_stretched(top: int, kind: type) -> None:
    """The 1st and 99th percentiles of a ramp from 20 % to 30 % are 20.1 % and 29.9 %."""
    image = Image.fromarray((ramp(0.2, 0.3) * top).round().astype(kind))
    assert tones(image) == pytest.approx((0.201, 0.299), abs=1 / 255)
    expected = (ramp(0.2, 0.3) - 0.201) / 0.098 * 255
    error = np.abs(np.asarray(stretched(image)) - expected.clip(0, 255)).max()
    assert error < (1 if kind is np.uint16 else 12)  # 8 bits have 25 levels there


def test_dark_images_are_stretched_for_features_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, (low, high) in {"1.png": (0, 1), "2.png": (0.05, 0.15), "3.png": (0, 0.001)}.items():
        Image.fromarray((ramp(low, high) * 255).astype(np.uint8)).convert("RGB").save(tmp_path / name)
    Image.fromarray((ramp(0, 4095 / 65535) * 65535).astype(np.uint16)).save(tmp_path / "4.png")
    sources = [Path(f"{n}.png") for n in (1, 2, 3, 4)]
    prepared, _ = prepare_all(tmp_path, sources, tmp_path / "images")
    before = {path.name: path.read_bytes() for path in (tmp_path / "images").iterdir()}
    folder = for_features(tmp_path, prepared, tmp_path / "images", tmp_path / "clear")
    assert folder == tmp_path / "clear"
    assert {path.name: path.read_bytes() for path in (tmp_path / "images").iterdir()} == before
    assert (folder / "1.png").read_bytes() == before["1.png"]
    deep = np.unique(np.asarray(Image.open(folder / "4.png")))
    assert len(deep) > 90  # of 16 bits, not of the 16 levels that 8 bits leave of 12
    assert np.ptp(np.asarray(Image.open(folder / "2.png"))) == 255
    said = " ".join(capsys.readouterr().err.split())
    assert "1 of 4 images are black and cannot be placed, the first: 3.png" in said
    assert "2 of 4 images have a small range of brightness" in said
    assert for_features(tmp_path, prepared[:1], tmp_path / "images", tmp_path / "other") == tmp_path / "images"


def test_black_and_white_images_are_refused(tmp_path: Path) -> None:
    for name, level, word in (("black", 3, "black, such as 1.png"), ("white", 255, "of one colour, such as 1.png")):
        folder = tmp_path / name
        folder.mkdir()
        for number in (1, 2, 3):
            Image.new("RGB", (40, 30), (level,) * 3).save(folder / f"{number}.png")
        prepared, _ = prepare_all(folder, [Path(f"{n}.png") for n in (1, 2, 3)], folder / "images")
        with pytest.raises(DataError, match=f"3 of 3 images are {word}"):
            for_features(folder, prepared, folder / "images", folder / "clear")

"""Photographs as they come: names, orientation, depth of colour, damage."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, features

from nerfloom.base import extras
from nerfloom.base.errors import DataError
from nerfloom.data.image_files import image_size, read_image
from nerfloom.processing.images import output_names, prepare, prepare_all, write_masks
from nerfloom.processing.listing import find_images


def write(path: Path, size: tuple[int, int] = (6, 4), mode: str = "RGB", orientation: int | None = None) -> np.ndarray:
    path.parent.mkdir(parents=True, exist_ok=True)
    draws = np.random.default_rng(0)
    pixels = draws.integers(0, 255, (size[1], size[0], 3)).astype(np.uint8)
    image = Image.fromarray(pixels).convert(mode)
    exif = image.getexif()
    if orientation is not None:
        exif[0x0112] = orientation
    image.save(path, exif=exif)
    return np.asarray(image)


def test_photographs_are_found_below_and_sorted_as_people_count(tmp_path: Path) -> None:
    for name in ("b/img10.png", "b/img2.png", "a 1.PNG", ".hidden/x.png", "notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"") if name.endswith("txt") else write(tmp_path / name)
    assert [p.as_posix() for p in find_images(tmp_path)] == ["a 1.PNG", "b/img2.png", "b/img10.png"]
    assert [p.as_posix() for p in find_images(tmp_path, leave_out=[tmp_path / "b"])] == ["a 1.PNG"]
    (tmp_path / "c").mkdir()
    with pytest.raises(DataError, match=r"a 1\.PNG is a file; name the folder of the images"):
        find_images(tmp_path / "a 1.PNG")
    with pytest.raises(DataError, match="has no image"):
        find_images(tmp_path / "c")


def test_kinds_that_are_not_read_are_counted_and_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path / "a.png")
    for name in ("b.DNG", "c.dng", "d.jxl", "notes.txt", ".e.dng"):
        (tmp_path / name).write_bytes(b"raw")
    assert find_images(tmp_path) == [Path("a.png")]
    said = " ".join(capsys.readouterr().err.split())
    assert "left out: 4 files that are not images: 2 .dng, 1 .jxl, 1 .txt; the first: b.DNG" in said


@pytest.mark.skipif(not features.check("avif"), reason="this Pillow is built without AVIF")
def test_avif_is_read(tmp_path: Path) -> None:
    write(tmp_path / "in" / "a.avif", (16, 12))
    (tmp_path / "out").mkdir()
    assert find_images(tmp_path / "in") == [Path("a.avif")]
    (found,), unreadable = prepare_all(tmp_path / "in", [Path("a.avif")], tmp_path / "out")
    assert (found.name, found.width, found.height, unreadable) == ("a.png", 16, 12, [])


@pytest.mark.parametrize("size", [(48, 32), (32, 48)])
def test_heic_is_read_with_its_package(tmp_path: Path, size: tuple[int, int]) -> None:
    """Photographs of phones are read as images of a data set, and prepared for a reconstruction."""
    pillow_heif = pytest.importorskip("pillow_heif", reason="pillow-heif is not installed: pip install pillow-heif")
    (tmp_path / "in").mkdir()
    (tmp_path / "out").mkdir()
    columns, rows = np.meshgrid(*(np.linspace(0, 255, count) for count in size))
    pixels = np.stack([columns, rows, 0.5 * columns], -1).round().astype(np.uint8)
    path = tmp_path / "in" / "a.HEIC"
    pillow_heif.from_pillow(Image.fromarray(pixels)).save(path, quality=100, chroma=444)
    assert image_size([path]) == size
    read = read_image(path)
    assert read.shape == (size[1], size[0], 4)
    assert (read[..., 3] == 255).all()
    assert np.abs(read[..., :3].astype(int) - pixels).max() <= 4
    (found,), unreadable = prepare_all(tmp_path / "in", [Path("a.HEIC")], tmp_path / "out")
    assert (found.width, found.height, unreadable) == (*size, [])
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(DataError, match=r"a\.HEIC is not a readable image: (?!HEIC needs)"):
        read_image(path)


def test_heic_without_its_package_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(64))
    with pytest.raises(DataError, match="HEIC needs another package: pip install pillow-heif"):
        read_image(tmp_path / "a.heic")


def test_digits_that_are_no_numbers_are_letters(tmp_path: Path) -> None:
    """Python takes a superscript for a digit, but makes no number of it."""
    for name in ("12²3.png", "9²3.png"):
        write(tmp_path / name)
    assert [path.name for path in find_images(tmp_path)] == ["9²3.png", "12²3.png"]


def test_names_are_safe_and_different() -> None:
    names = output_names([Path("a b.JPG"), Path("a_b.jpg"), Path("sub dir/x.tif"), Path("A_B.jpg")])
    assert names == ["a_b.jpg", "a_b_2.jpg", "sub_dir/x.png", "A_B_3.jpg"]
    assert output_names([Path("#1.jpg"), Path("_1.jpg"), Path("a/#1.jpg")]) == ["_1.jpg", "_1_2.jpg", "a/#1.jpg"]


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_photographs_are_turned_upright(orientation: int, tmp_path: Path) -> None:
    stored = write(tmp_path / "in" / "x.png", orientation=orientation)
    found = prepare(tmp_path / "in", Path("x.png"), tmp_path / "out", "x.png")
    turned = {1: stored, 3: stored[::-1, ::-1], 6: np.rot90(stored, -1), 8: np.rot90(stored)}[orientation]
    with Image.open(tmp_path / "out" / "x.png") as image:
        assert (image.width, image.height) == (found.width, found.height) == turned.shape[1::-1]
        assert image.getexif().get(0x0112, 1) == 1
        assert np.array_equal(np.asarray(image.convert("RGB")), turned)


def test_sixteen_bits_of_grey_become_eight(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    Image.fromarray(np.array([[0, 257 * 100, 65535]], np.uint16)).save(tmp_path / "in" / "x.png")
    prepare(tmp_path / "in", Path("x.png"), tmp_path / "out", "x.png")
    with Image.open(tmp_path / "out" / "x.png") as image:
        assert np.asarray(image)[0, :, 0].tolist() == [0, 100, 255]


def test_damaged_photographs_are_left_out_and_named(tmp_path: Path) -> None:
    write(tmp_path / "good.png")
    (tmp_path / "bad.png").write_bytes((tmp_path / "good.png").read_bytes()[:60])
    (tmp_path / "worse.jpg").write_text("no image")
    sources = find_images(tmp_path)
    photographs, unreadable = prepare_all(tmp_path, sources, tmp_path / "out")
    assert [p.source for p in photographs] == ["good.png"]
    assert len(unreadable) == 2
    assert "bad.png" in unreadable[0]


def test_masks_are_found_whatever_they_are_saved_as(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = ["a.png", "cam/B.JPG", "cam/c.jpg", "d.jpg", "e.jpg"]
    for name in names:
        write(tmp_path / "given" / name)
    left = np.repeat([[255, 255, 255, 0, 0, 0]], 4, 0).astype(np.uint8)
    for name in ("a.bmp", "cam/b.PNG", "cam/c.jpg.png", "d.png"):
        (tmp_path / "masks" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(left // 255 if name == "d.png" else left).save(tmp_path / "masks" / name)
    prepared, _ = prepare_all(tmp_path / "given", [Path(name) for name in names], tmp_path / "out")
    written = write_masks(tmp_path / "masks", prepared, tmp_path / "written")
    assert set(written) == {"a.png", "cam/B.jpg", "cam/c.jpg", "d.jpg"}
    for name in written.values():
        assert np.array_equal(np.asarray(Image.open(tmp_path / "written" / name)), left)
    assert "1 of 5 images have no mask, the first e.jpg" in capsys.readouterr().err
    (tmp_path / "others").mkdir()
    with pytest.raises(DataError, match=r"has no mask; the first expected is a\.png"):
        write_masks(tmp_path / "others", prepared, tmp_path / "written")


def test_profiles_of_other_colours_are_not_kept(tmp_path: Path) -> None:
    """Programs that manage colours would take RGB for what the profile describes, or refuse the file."""
    for colours, mode, suffix in ((b"RGB ", "P", "png"), (b"GRAY", "L", "jpg"), (b"CMYK", "CMYK", "jpg")):
        profile = bytes(16) + colours + bytes(108)
        name = f"{mode}.{suffix}"
        Image.new("RGB", (6, 4), "red").convert(mode).save(tmp_path / name, icc_profile=profile)
        prepare(tmp_path, Path(name), tmp_path / "out", name)
        with Image.open(tmp_path / "out" / name) as image:
            assert image.mode == "RGB"
            assert image.info.get("icc_profile", b"") == (profile if mode == "P" else b"")


def test_pixels_without_a_white_level_are_refused_by_name(tmp_path: Path) -> None:
    Image.fromarray(np.ones((4, 6), np.float32)).save(tmp_path / "bright.tif")
    with pytest.raises(DataError, match=r"bright\.tif is not a readable image: floating-point pixels; convert it"):
        prepare(tmp_path, Path("bright.tif"), tmp_path / "out", "bright.png")

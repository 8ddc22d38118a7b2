"""Images in memory: decoded values equal the stored ones, or values computed by hand."""

import os
import struct
import zlib
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from PIL import Image, PngImagePlugin

from nerfloom.base.errors import DataError
from nerfloom.data.dataset import assemble, existing_files, load_dataset
from nerfloom.data.decoding import from_arrays
from nerfloom.data.image_files import image_size, read_image
from nerfloom.data.masks import read_mask
from nerfloom.data.pixels.batch import background_colors, composite
from nerfloom.dataparsers.blender import Blender
from nerfloom.processing.images import prepare
from tests.images import noise, parsed, write_mask


def write_deep_png(path: Path, channels: int, size: int = 20) -> None:
    """A valid PNG of 16 bits a channel, written by hand: imageio and Pillow write none in colour."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    color_type = {1: 0, 3: 2, 4: 6}[channels]
    row = b"\0" + struct.pack(f">{size * channels}H", *[40000] * size * channels)
    header = struct.pack(">IIBBBBB", size, size, 16, color_type, 0, 0, 0)
    parts = [chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(row * size)), chunk(b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_sixteen_bits_a_channel_are_refused_not_cut(tmp_path: Path, channels: int) -> None:
    write_deep_png(tmp_path / "deep.png", channels)
    with pytest.raises(DataError, match=r"deep\.png .*8 bits per channel; convert"):
        read_image(tmp_path / "deep.png")


def test_a_sixteen_bit_image_in_a_set_is_skipped_and_named(tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_deep_png(tiny / "train" / "r_3.png", 1)
    assert len(load_dataset(Blender().parse(tiny, "train"), "train")) == 9
    said = capsys.readouterr().err
    assert "1 of 10 images are unreadable and skipped" in said
    assert "r_3.png has more than 8 bits" in said


def write_animation(path: Path, size: tuple[int, int] = (20, 20)) -> Path:
    """Three pictures, each of one grey, in the format that the ending asks for; then it is called .png."""
    pictures = [Image.new("L", size, 50 * index + 50) for index in range(3)]
    pictures[0].save(path, save_all=True, append_images=pictures[1:])
    return path.rename(path.with_suffix(".png"))


@pytest.mark.parametrize("ending", [".gif", ".png"])
def test_of_an_animation_the_first_picture_is_taken(tiny: Path, ending: str) -> None:
    path = write_animation(tiny / "train" / f"r_0{ending}")
    assert image_size([path]) == (20, 20)
    assert np.array_equal(read_image(path), np.broadcast_to(np.uint8([50, 50, 50, 255]), (20, 20, 4)))
    assert read_mask(path, 20, 20).shape == (20, 20)
    data = load_dataset(Blender().parse(tiny, "train"), "train")
    assert len(data) == 10
    assert data.image(0)[7, 7].tolist() == [50, 50, 50, 255]
    assert np.array_equal(data.image(1).numpy(), iio.imread(tiny / "train" / "r_1.png"))  # nothing was written over it


@pytest.mark.parametrize("size", [(0, 20), (20, 0), (0, 0)])
def test_an_image_without_a_pixel(tmp_path: Path, size: tuple[int, int]) -> None:
    path = tmp_path / "none.png"
    write_deep_png(path, 1, 1)
    whole = path.read_bytes()
    header = b"IHDR" + struct.pack(">IIBBBBB", *size, 8, 0, 0, 0, 0)
    path.write_bytes(whole[:12] + header + struct.pack(">I", zlib.crc32(header)) + whole[33:])
    with pytest.raises(DataError, match=r"none\.png"):
        image_size([path])
    with pytest.raises(DataError, match=r"none\.png"):
        read_mask(path, 1, 1)


@pytest.mark.skipif(os.name != "posix", reason="puts a shell script in the way")
def test_no_program_is_run_for_an_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pillow has PostScript drawn by Ghostscript, and recognises it by its content, under any name."""
    program = tmp_path / "bin" / "gs"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\ntouch {tmp_path / 'proof'}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent), prepend=os.pathsep)
    script = tmp_path / "photograph.png"
    script.write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 20 20\n%%EndComments\nshowpage\n%%EOF\n")
    with pytest.raises(DataError, match=r"photograph\.png is not a readable image"):
        read_image(script)
    with pytest.raises(DataError, match=r"photograph\.png is not a readable image"):
        prepare(tmp_path, Path("photograph.png"), tmp_path / "out", "photograph.png")
    assert not (tmp_path / "proof").exists()


def test_palette_images_keep_their_transparency(tmp_path: Path) -> None:
    picture = Image.new("P", (2, 1))
    picture.putpalette([10, 20, 30, 200, 100, 50])
    picture.putdata([0, 1])
    picture.save(tmp_path / "p.png", transparency=1)
    assert read_image(tmp_path / "p.png").tolist() == [[[10, 20, 30, 255], [200, 100, 50, 0]]]


def test_a_file_is_decoded_once(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parsed_scene, decoded = Blender().parse(tiny, "train"), []
    prepare_to_decode = PngImagePlugin.PngImageFile.load_prepare

    def noted(image: PngImagePlugin.PngImageFile) -> None:
        decoded.append(image)
        prepare_to_decode(image)

    monkeypatch.setattr(PngImagePlugin.PngImageFile, "load_prepare", noted)
    assert len(load_dataset(parsed_scene, "train")) == len(decoded) == 10


def test_an_opaque_set_has_no_alpha_and_is_kept_in_three_channels(tiny: Path) -> None:
    for file in (tiny / "train").glob("*.png"):
        iio.imwrite(file, np.full((20, 20, 4), 255, dtype=np.uint8))
    data = load_dataset(Blender().parse(tiny, "train"), "train")
    assert not data.scene.has_alpha
    assert data.image(0).shape == (20, 20, 3)


@pytest.mark.parametrize(("kind", "behind"), [("white", 1.0), ("black", 0.0)])
def test_loaded_alpha_is_straight_and_composited_by_hand(tiny: Path, kind: str, behind: float) -> None:
    rgba = np.zeros((20, 20, 4), dtype=np.uint8)
    rgba[4, 7] = (200, 100, 0, 51)  # a fifth opaque
    iio.imwrite(tiny / "train" / "r_0.png", rgba)
    image = load_dataset(Blender().parse(tiny, "train"), "train").image(0)
    assert image[4, 7].tolist() == [200, 100, 0, 51]
    background = background_colors(kind, 1, torch.device("cpu"))  # type: ignore[arg-type]
    found = composite(image[4, 7][None].float() / 255, background)
    expected = [[value / 255 * 0.2 + 0.8 * behind for value in (200, 100, 0)]]
    torch.testing.assert_close(found, torch.tensor(expected))


def test_a_transparent_neighbour_lends_no_colour_when_images_are_reduced(tiny: Path) -> None:
    rgba = np.zeros((20, 20, 4), dtype=np.uint8)
    rgba[..., :3] = 255
    rgba[0, 0] = (30, 60, 90, 255)
    iio.imwrite(tiny / "train" / "r_0.png", rgba)
    image = load_dataset(Blender(downscale_factor=2).parse(tiny, "train"), "train").image(0)
    assert image[0, 0].tolist() == [30, 60, 90, 64]  # 255 / 4 = 63.75


@pytest.mark.parametrize("factor", [3, 20])
def test_a_rest_that_fills_no_block_is_cut_off(tiny: Path, factor: int) -> None:
    data = load_dataset(Blender(downscale_factor=factor).parse(tiny, "train"), "train")
    assert data.image(0).shape == (20 // factor, 20 // factor, 4)
    assert data.cameras.fx[0].item() == pytest.approx(10 / np.tan(0.35) / factor)


@pytest.mark.parametrize("factor", [21, 1000])
def test_reducing_to_nothing_is_an_error(tiny: Path, factor: int) -> None:
    with pytest.raises(DataError, match="downscale"):
        load_dataset(Blender(downscale_factor=factor).parse(tiny, "train"), "train")


def test_the_size_comes_from_the_first_image_that_can_be_read(tiny: Path) -> None:
    paths = [tiny / "train" / f"r_{index}.png" for index in range(3)]
    paths[0].write_bytes(b"no image")
    assert image_size(paths) == (20, 20)
    with pytest.raises(DataError, match=r"r_0\.png is not a readable image"):
        image_size(paths[:1])


def test_missing_files_are_counted_once_and_all_missing_is_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = [tmp_path / f"{index}.png" for index in range(4)]
    paths[1].touch()
    assert existing_files(paths, "val").tolist() == [1]
    said = capsys.readouterr().err
    assert said.count("split 'val': 3 of 4 images are missing and skipped") == 1
    assert str(paths[0]) in said
    with pytest.raises(DataError, match="split 'test' has no image"):
        existing_files(paths[:1], "test")


def test_moving_a_set_to_a_device_keeps_everything(shared_tiny: Path) -> None:
    data = load_dataset(Blender().parse(shared_tiny, "val"), "val")
    moved = data.to("cpu")
    assert torch.equal(moved.pixels, data.pixels)
    assert moved.names == data.names
    assert torch.equal(moved.image(1), data.image(1))


@pytest.mark.parametrize("channels", [3, 4])
def test_arrays_make_the_data_set_that_their_files_make(tmp_path: Path, channels: int) -> None:
    sizes = [(30, 20), (12, 40), (25, 25)]
    images = [noise(*size, index, channels) for index, size in enumerate(sizes)]
    used = [np.random.default_rng(index).random((height, width)) < 0.6 for index, (width, height) in enumerate(sizes)]
    paths = [tmp_path / f"{index}.png" for index in range(3)]
    for path, image in zip(paths, images, strict=True):
        iio.imwrite(path, image)
    masks = [write_mask(tmp_path / f"mask_{index}.png", mask) for index, mask in enumerate(used)]
    there = load_dataset(parsed(paths, sizes, list(masks)), "train")
    here = assemble(parsed(paths, sizes), from_arrays(images, used), "train")
    assert torch.equal(here.pixels, there.pixels)
    assert here.kept is not None
    assert there.kept is not None
    assert torch.equal(here.kept.pixels(), there.kept.pixels())
    assert here.scene.has_alpha == there.scene.has_alpha == (channels == 4)
    assert here.scene.appearance_varies == there.scene.appearance_varies
    assert here.names == there.names == ("0.png", "1.png", "2.png")
    assert (here.light is None) == (there.light is None) == (channels == 4)
    if here.light is not None and there.light is not None:
        assert torch.equal(here.light, there.light)


def test_arrays_of_both_kinds_become_one_and_an_opaque_alpha_is_dropped() -> None:
    opaque = np.dstack([noise(4, 3, 0), np.full((3, 4), 255, np.uint8)])
    assert from_arrays([opaque, noise(4, 3, 1)]).pixels.shape == (24, 3)
    opaque[1, 2, 3] = 7
    pixels = from_arrays([opaque, noise(4, 3, 1)]).pixels
    assert torch.equal(pixels[:12], torch.from_numpy(opaque).view(12, 4))
    assert torch.equal(pixels[12:, :3], torch.from_numpy(noise(4, 3, 1)).view(12, 3))
    assert bool((pixels[12:, 3] == 255).all())


def test_arrays_that_are_no_images_and_masks_that_leave_nothing_are_refused() -> None:
    with pytest.raises(DataError, match=r"image 1 is float64 \(3, 4, 3\); it must be uint8"):
        from_arrays([noise(4, 3, 0), noise(4, 3, 1) / 255])
    with pytest.raises(DataError, match="the masks keep no pixel"):
        from_arrays([noise(4, 3, 0)], [np.zeros((3, 4), bool)])
    assert from_arrays([noise(4, 3, 0)], [np.ones((3, 4), bool)]).kept is None

"""Depth in OpenEXR files: every kind that is read, and a reason for every kind that is not."""

from pathlib import Path

import numpy as np
import pytest

from nerfloom.base.errors import DataError
from nerfloom.data.depths import read_depth
from tests.exr_files import NONE, PIZ, RLE, ZIP, ZIPS, write_exr

HEIGHT, WIDTH = 37, 29


def surface(kind: str) -> np.ndarray:
    """Depths with long runs of equal ones, a ramp, and noise that no compression makes smaller."""
    depths = np.full((HEIGHT, WIDTH), 2.5)
    depths[8:20] += np.arange(WIDTH) / 7
    depths[20:] = np.random.default_rng(0).uniform(0.1, 9, (HEIGHT - 20, WIDTH))
    return (depths * (1000 if kind == "uint32" else 1)).astype(kind)


@pytest.mark.parametrize("kind", ["float16", "float32", "uint32"])
@pytest.mark.parametrize("compression", [NONE, RLE, ZIPS, ZIP])
@pytest.mark.parametrize("name", ["Z", "ViewLayer.Depth.Z", "V"])
def test_depths_are_read_to_the_bit(tmp_path: Path, kind: str, compression: int, name: str) -> None:
    """Among channels of other types, before and behind it."""
    other = np.random.default_rng(1).uniform(size=(HEIGHT, WIDTH))
    channels = {"A": other.astype("float16"), name: surface(kind), "zzz": other.astype("float32")}
    write_exr(tmp_path / "d.EXR", channels, compression)
    assert np.array_equal(read_depth(tmp_path / "d.EXR", WIDTH, HEIGHT), surface(kind).astype(np.float32))


def test_a_single_channel_may_have_any_name(tmp_path: Path) -> None:
    write_exr(tmp_path / "d.exr", {"how far": surface("float32")})
    assert np.array_equal(read_depth(tmp_path / "d.exr", WIDTH, HEIGHT), surface("float32"))


def test_what_is_not_read_is_refused_for_its_reason(tmp_path: Path) -> None:
    file, depths = tmp_path / "d.exr", surface("float32")

    def refused(words: str) -> None:
        with pytest.raises(DataError, match=words) as error:
            read_depth(file, WIDTH, HEIGHT)
        assert "the depth image" in str(error.value)
        assert "\n" not in str(error.value)

    write_exr(file, {"Z": depths}, PIZ)
    refused("its compression PIZ is not supported; save it with ZIP")
    write_exr(file, {"Z": depths}, flags=0x200)
    refused("tiles, deep pixels and several parts are not supported")
    write_exr(file, {"B": depths, "G": depths})
    refused("none of its channels B, G looks like depth")
    write_exr(file, {"Z": depths})
    whole = file.read_bytes()
    for share in (0.01, 0.1, 0.5, 0.99):
        file.write_bytes(whole[: int(share * len(whole))])
        refused("truncated|damaged|lacks")
    file.write_bytes(b"no picture")
    refused("its content is not OpenEXR")
    file.write_bytes(whole)
    with pytest.raises(DataError, match="29 x 37 pixels, its image 2 x 2"):
        read_depth(file, 2, 2)

"""KSPLAT files, as GaussianSplats3D writes them, and damaged ones."""

import math
import struct
from pathlib import Path

import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.splats.files import read_gaussians
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import ELSEWHERE
from tests.splats.foreign_files import write_ksplat
from tests.splats.test_files import some
from tests.splats.test_foreign_files import angles


def given(count: int, degree: int) -> Gaussians:
    gaussians = some(count, degree)
    gaussians.colors.clamp_(-1.7, 1.7)
    return gaussians


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_ksplat(tmp_path: Path, degree: int, level: int) -> None:
    """Exact at level 0. Else half a step of a bucket, and half floats: 1/2048 of a number; a step of 8 bits."""
    expected, file = given(300, degree), tmp_path / "a.ksplat"
    order = write_ksplat(file, expected, level)
    read, look = read_gaussians(file)
    assert sorted(order) == list(range(300))
    expected = expected[torch.tensor(order)]
    assert look == ELSEWHERE
    assert read.degree == degree
    half_step = 0.5 * 2.5 / 32767
    assert float((read.means - expected.means).abs().max()) <= (half_step + 3e-6 if level else 0)
    assert float((read.log_scales - expected.log_scales).abs().max()) <= (6e-4 if level else 1e-6)
    assert float(angles(read, expected).max()) < (0.15 if level else 0.05)
    opacity = expected.logits.sigmoid() - read.logits.sigmoid()
    assert float(opacity.min()) >= -0.25 / 255 - 1e-6  # of 0, which has no logit
    assert float(opacity.max()) <= 1 / 255 + 1e-6
    assert float((read.colors - expected.colors).abs().max()) <= 1 / 255 / 0.28209 + 1e-5
    if degree:
        off = (read.harmonics - expected.harmonics).abs()
        spread = float(expected.harmonics.max() - expected.harmonics.min())
        assert float(off.max()) <= (0, 1e-3, spread / 255 + 1e-5)[level]


def test_what_is_in_a_ksplat_by_hand(tmp_path: Path) -> None:
    """Level 1: a full bucket of one, and a partial one; degree 1; a range of steps that the header does not state."""
    start, header = bytearray(4096), bytearray(1024)
    struct.pack_into("<4B4IH", start, 0, 0, 1, 0, 0, 1, 1, 2, 2, 1)
    struct.pack_into("<4IfH", header, 0, 2, 2, 1, 2, 8.0, 12)
    struct.pack_into("<2IH", header, 32, 1, 1, 1)
    rows = b""
    for steps in ((32767, 65534, 0), (0, 32767, 32767)):
        rows += struct.pack("<3H3e4e4B", *steps, 0.5, 0.25, 0.0, 0.5, -0.5, 0.5, 0.5, 255, 0, 128, 51)
        rows += struct.pack("<9e", *(0.125 * index for index in range(9)))
    buckets = struct.pack("<I", 1) + struct.pack("<6f", 1, 2, 3, -10, 0, 0)
    file = tmp_path / "a.ksplat"
    file.write_bytes(bytes(start) + bytes(header) + buckets + rows)
    read = read_gaussians(file).gaussians
    torch.testing.assert_close(read.means, torch.tensor([[1.0, 6.0, -1.0], [-14.0, 0.0, 0.0]]))
    torch.testing.assert_close(read.log_scales[0, :2].exp(), torch.tensor([0.5, 0.25]))
    assert float(read.log_scales[0, 2].exp()) < 1e-20
    assert read.rotations[1].tolist() == [0.5, -0.5, 0.5, 0.5]
    torch.testing.assert_close(0.5 + 0.28209479 * read.colors[0], torch.tensor([1.0, 0.0, 128 / 255]))
    assert float(read.logits[0].sigmoid()) == pytest.approx(51 / 255)
    assert torch.equal(read.harmonics[0], 0.125 * torch.arange(9.0).reshape(3, 3))  # all of red first


def test_sections_may_have_different_degrees(tmp_path: Path) -> None:
    file, other = tmp_path / "a.ksplat", tmp_path / "b.ksplat"
    write_ksplat(file, given(8, 0), 0)
    write_ksplat(other, given(8, 2), 0)
    low, high = file.read_bytes(), other.read_bytes()
    # The first section of one, and the second of the other.
    content = low[: 4096 + 1024] + high[4096 + 1024 : 4096 + 2048] + low[4096 + 2048 :][: 4 * 44] + high[-4 * 140 :]
    file.write_bytes(content)
    read = read_gaussians(file).gaussians
    assert read.degree == 2
    assert not bool(read.harmonics[:4].any())
    assert bool(read.harmonics[4:].any())


def test_damaged_ksplat_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.ksplat"
    write_ksplat(file, given(40, 1), 2)
    whole = file.read_bytes()

    def said(offset: int, kind: str, *values: float) -> str:
        content = bytearray(whole)
        struct.pack_into(kind, content, offset, *values)
        file.write_bytes(content)
        with pytest.raises(DataError) as error:
            read_gaussians(file)
        assert "a.ksplat" in str(error.value)
        return str(error.value)

    assert "of version 1.1" in said(0, "<B", 1)
    assert "of version 0.0" in said(1, "<B", 0)
    assert "4,294,967,295 sections" in said(4, "<I", 2**32 - 1)
    assert "states 41 Gaussians" in said(16, "<I", 41)
    assert "level 3" in said(20, "<H", 3)
    assert "none of its 40 Gaussians is finite" in said(36, "<f", math.nan)
    assert "truncated" in said(4096, "<2I", 2**32 - 1, 2**32 - 1)
    assert "truncated" in said(4096, "<I", 21)  # more than there is room for
    assert "too few Gaussians" in said(4096 + 2048, "<I", 0)  # the length of a bucket
    assert "truncated" in said(4096 + 12, "<I", 2**32 - 1)
    assert "buckets of 0 bytes" in said(4096 + 20, "<H", 0)
    assert "buckets" in said(4096 + 32, "<I", 2**31)
    assert "degree 3" in said(4096 + 40, "<H", 3)
    for size in range(0, len(whole), 331):
        file.write_bytes(whole[:size])
        with pytest.raises(DataError, match=r"a\.ksplat"):
            read_gaussians(file)

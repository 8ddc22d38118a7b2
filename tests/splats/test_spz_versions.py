"""SPZ of versions 1, 3 and 4: bytes by hand, and written files, unpacked without our reader."""

import gzip
import struct
from itertools import pairwise
from pathlib import Path

import pytest
import torch

from nerfloom.base.errors import ConfigError, DataError
from nerfloom.splats.files import read_gaussians, write_gaussians
from nerfloom.splats.look import ELSEWHERE, OURS, Look
from nerfloom.splats.spz import encoded
from nerfloom.splats.spz_container import SpzVersion
from tests.splats.test_files import LOOKS, body, packed, some
from tests.splats.test_foreign_files import angles

zstandard = pytest.importorskip("zstandard")
WIDTHS = (9, 1, 3, 3, 4)
ROTATION = struct.pack("<I", 3 << 30 | 100 << 20 | (1 << 9 | 200) << 10 | 300)
DRAWING = 0x4E460001


def frame(content: bytes) -> bytes:
    """A Zstandard frame (RFC 8878) of at most 255 bytes that are not compressed: one segment, one last raw block."""
    block = (len(content) << 3 | 1).to_bytes(3, "little") + content
    return b"\x28\xb5\x2f\xfd" + bytes([0x20, len(content)]) + block


def by_hand(degree: int = 1, flags: int = 0, extensions: bytes = b"", version: int = 4) -> bytes:
    """The Gaussian of `body`, in the layout of version 4."""
    content = body(ROTATION, bytes(range(100, 109)) if degree else b"")
    cuts = [sum(WIDTHS[:index]) for index in range(len(WIDTHS) + 1)] + ([len(content)] if degree else [])
    arrays = [content[start:end] for start, end in pairwise(cuts)]
    frames = [frame(array) for array in arrays]
    table = 32 + len(extensions)
    header = struct.pack("<IIIBBBBI12x", 0x5053474E, version, 1, degree, 8, flags, len(frames), table)
    sizes = b"".join(struct.pack("<QQ", len(one), len(array)) for one, array in zip(frames, arrays, strict=True))
    return header + extensions + sizes + b"".join(frames)


@pytest.mark.parametrize("degree", [0, 1])
def test_version_4_by_hand(tmp_path: Path, degree: int) -> None:
    """The numbers of version 3, in another container."""
    (tmp_path / "a.spz").write_bytes(by_hand(degree, flags=1))
    (tmp_path / "b.spz").write_bytes(
        packed(3, 1, degree, body(ROTATION, bytes(range(100, 109)) if degree else b""), flags=1)
    )
    found, expected = (read_gaussians(tmp_path / name) for name in ("a.spz", "b.spz"))
    assert found.look == expected.look == Look(antialiased=True, sort="depth")
    assert found.gaussians.degree == degree
    for name, values in expected.gaussians.columns.items():
        assert torch.equal(found.gaussians.columns[name], values), name


def test_version_1_by_hand(tmp_path: Path) -> None:
    """Positions are half floats, and rotations as in version 2."""
    later = body(bytes([255, 127, 128]))
    (tmp_path / "a.spz").write_bytes(packed(1, 1, 0, struct.pack("<3e", 1.5, -2, 0.25) + later[9:]))
    (tmp_path / "b.spz").write_bytes(packed(2, 1, 0, later))
    found, expected = (read_gaussians(tmp_path / name).gaussians for name in ("a.spz", "b.spz"))
    assert found.means.tolist() == [[1.5, 2.0, -0.25]]
    for name, values in expected.columns.items():
        assert torch.equal(found.columns[name], values), name


def test_extensions_say_how_they_are_drawn(tmp_path: Path) -> None:
    """Ours is read, another's is passed over, and axes that are not the usual ones are refused."""
    text = b"SplatBlur: 0.1\nSplatSort: distance"
    other = struct.pack("<II", 0xADBE0002, 12) + bytes(12)
    (tmp_path / "a.spz").write_bytes(by_hand(1, 2, other + struct.pack("<II", DRAWING, len(text)) + text))
    assert read_gaussians(tmp_path / "a.spz").look == Look(blur=0.1)
    for axes in (0, 4):
        (tmp_path / "a.spz").write_bytes(by_hand(1, 2, struct.pack("<III", 0xADBE0003, 4, axes)))
        assert read_gaussians(tmp_path / "a.spz").look == ELSEWHERE
    (tmp_path / "a.spz").write_bytes(by_hand(1, 2, struct.pack("<III", 0xADBE0003, 4, 6)))
    with pytest.raises(DataError, match=r"a\.spz has axes that are not read, number 6"):
        read_gaussians(tmp_path / "a.spz")
    for damaged in (b"\1", struct.pack("<II", DRAWING, 2**32 - 1), bytes(40)):
        (tmp_path / "a.spz").write_bytes(by_hand(1, 2, damaged))
        assert read_gaussians(tmp_path / "a.spz").look == ELSEWHERE


@pytest.mark.parametrize("degree", range(4))
def test_what_is_written_holds_the_arrays_of_version_3(degree: int) -> None:
    gaussians = some(500, degree)
    third = gzip.decompress(encoded(gaussians, version=3))
    fourth = encoded(gaussians, version=4)
    magic, version, count, found, fraction, flags, number, table = struct.unpack_from("<4sIIBBBBI", fourth)
    assert (magic, version, count, found, flags, number) == (b"NGSP", 4, 500, degree, 2, 6 if degree else 5)
    assert third[:14] == struct.pack("<4sIIBB", b"NGSP", 3, 500, degree, fraction)
    assert fourth[20:32] == bytes(12)
    start, arrays = table + 16 * number, []
    for index in range(number):
        length, size = struct.unpack_from("<QQ", fourth, table + 16 * index)
        arrays.append(zstandard.ZstdDecompressor().decompress(fourth[start : start + length]))
        assert len(arrays[-1]) == size
        start += length
    assert start == len(fourth)
    assert b"".join(arrays) == third[16:]


@pytest.mark.parametrize("version", [3, 4])
def test_written_rotations_are_off_by_a_third_of_a_degree_at_most(tmp_path: Path, version: SpzVersion) -> None:
    gaussians, file = some(20_000, 0), tmp_path / "a.spz"
    gaussians.colors.clamp_(-3, 3)  # the range of SPZ
    assert write_gaussians(file, gaussians, spz_version=version) == []
    read = read_gaussians(file).gaussians
    off = float(angles(read, gaussians).max())
    print(f"rotations are off by up to {off:.2f} degrees")
    assert off < 0.3
    assert float((read.log_scales - gaussians.log_scales).abs().max()) <= 1 / 32 + 1e-6  # axis by axis
    assert float((read.means - gaussians.means).abs().max()) <= 0.5 / 4096 + 1e-6


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize("look", LOOKS)
def test_every_version_says_how_gaussians_are_drawn(tmp_path: Path, look: Look, version: SpzVersion) -> None:
    file = tmp_path / "a.spz"
    write_gaussians(file, some(20), look=look, spz_version=version)
    assert read_gaussians(file).look == look
    write_gaussians(file, some(3000), 0.1, look, version)
    assert file.stat().st_size <= 1e5
    assert read_gaussians(file).look == look


def test_version_4_has_an_extension_only_if_it_must() -> None:
    for look, table in ((ELSEWHERE, 32), (Look(True, sort="depth"), 32), (OURS, 32 + 8 + 44)):
        assert struct.unpack_from("<I", encoded(some(3), look=look, version=4), 16) == (table,)
    assert len("SplatRenderMode: default\nSplatSort: distance") == 44


def test_truncated_version_4_is_refused_wherever_it_ends(tmp_path: Path) -> None:
    whole, file = encoded(some(300), version=4), tmp_path / "a.spz"
    for size in [*range(0, len(whole), 97), len(whole) - 1]:
        file.write_bytes(whole[:size])
        with pytest.raises(DataError, match=r"a\.spz"):
            read_gaussians(file)


def test_version_4_with_a_wrong_byte_is_refused(tmp_path: Path) -> None:
    """The wrong byte is in the arrays, which have checksums."""
    whole, file = encoded(some(300), version=4), tmp_path / "a.spz"
    start = struct.unpack_from("<I", whole, 16)[0] + 6 * 16
    for place in range(start, len(whole), 61):
        damaged = bytearray(whole)
        damaged[place] ^= 1
        file.write_bytes(damaged)
        with pytest.raises(DataError, match=r"a\.spz is damaged"):
            read_gaussians(file)


def test_headers_of_version_4_that_cannot_be_are_refused(tmp_path: Path) -> None:
    file, whole = tmp_path / "a.spz", by_hand()

    def said(offset: int, kind: str, value: int) -> str:
        content = bytearray(whole)
        struct.pack_into(kind, content, offset, value)
        file.write_bytes(content)
        with pytest.raises(DataError) as error:
            read_gaussians(file)
        assert "a.spz" in str(error.value)
        return str(error.value)

    assert "SPZ of version 5;" in said(4, "<I", 5)
    assert "SPZ of version 3;" in said(4, "<I", 3)
    assert "4,294,967,295 Gaussians" in said(8, "<I", 2**32 - 1)
    assert "truncated" in said(8, "<I", 2**31 - 1)  # no memory is asked for
    assert "truncated" in said(8, "<I", 2)
    assert "degree 5" in said(12, "<B", 5)
    assert "number of arrays" in said(12, "<B", 0)
    assert "31 fractional" in said(13, "<B", 31)
    for number in (0, 5, 7, 255):
        assert "number of arrays" in said(15, "<B", number)
    for table in (0, 31, 2**32 - 1):
        assert "truncated" in said(16, "<I", table)
    assert "truncated" in said(32, "<Q", 2**64 - 1)
    assert "truncated" in said(40, "<Q", 2**64 - 1)
    assert "damaged" in said(32 + 6 * 16, "<I", 0)  # the start of a frame


def test_a_frame_that_claims_much_is_not_believed(tmp_path: Path) -> None:
    """Its own header states 2^60 bytes."""
    whole = bytearray(by_hand(0))
    claim = b"\x28\xb5\x2f\xfd" + bytes([0xE0]) + struct.pack("<Q", 2**60) + (1).to_bytes(3, "little")
    start = 32 + 5 * 16
    length = struct.unpack_from("<Q", whole, 32)[0]
    struct.pack_into("<Q", whole, 32, len(claim))
    (tmp_path / "a.spz").write_bytes(bytes(whole[:start]) + claim + bytes(whole[start + length :]))
    with pytest.raises(DataError, match=r"a\.spz is damaged"):
        read_gaussians(tmp_path / "a.spz")


def test_the_package_that_version_4_needs_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.spz").write_bytes(by_hand())
    monkeypatch.setattr("nerfloom.base.extras.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"a\.spz is SPZ of version 4, and needs .*: pip install zstandard"):
        read_gaussians(tmp_path / "a.spz")
    with pytest.raises(ConfigError, match=r"SPZ of version 4 needs .*: pip install zstandard"):
        encoded(some(3), version=4)
    write_gaussians(tmp_path / "b.spz", some(3), spz_version=3)  # the others need none
    assert len(read_gaussians(tmp_path / "b.spz").gaussians) == 3

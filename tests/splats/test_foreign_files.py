"""Files of other programs: .splat, compressed PLY, Mip-Splatting's filter, and unreadable files."""

import math
import struct
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.splats.files import is_splat_file, read_gaussians
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import ELSEWHERE, OURS, Look
from nerfloom.splats.ply import property_names
from tests.splats.foreign_files import write_compressed, write_splat
from tests.splats.test_files import covariances, matrices, some

MIP_SPLATTING = Look(antialiased=True, blur=0.1, sort="depth")


def angles(first: Gaussians, second: Gaussians) -> torch.Tensor:
    """Degrees between the axes of Gaussians."""
    turns = matrices(first.rotations).mT @ matrices(second.rotations)
    return (((turns.diagonal(dim1=1, dim2=2).sum(1)) - 1) / 2).clamp(-1, 1).acos().rad2deg()


def test_splat(tmp_path: Path) -> None:
    """Half a step of 8 bits: 1/510 of an opacity, 1/144 of a coefficient, about half a degree."""
    given = some(200, 0)
    given.colors.clamp_(-1.7, 1.7)
    write_splat(tmp_path / "a.splat", given)
    read, look = read_gaussians(tmp_path / "a.splat")
    assert look == ELSEWHERE
    assert read.degree == 0
    torch.testing.assert_close(read.means, given.means, rtol=0, atol=0)
    torch.testing.assert_close(read.log_scales, given.log_scales, rtol=0, atol=1e-6)
    assert float((read.logits.sigmoid() - given.logits.sigmoid()).abs().max()) <= 0.5 / 255 + 1e-6
    assert float((read.colors - given.colors).abs().max()) <= 0.5 / 255 / 0.28209 + 1e-6
    assert float(angles(read, given).max()) < 1.0


def test_what_is_in_a_splat_by_hand(tmp_path: Path) -> None:
    """One row without a size along z, and two that are left out."""
    rows = [(1.0, 2.0, -3.0, 0.5, 0.25, 0.0, 255, 0, 128, 64, 128, 255, 128, 128)]
    rows += [(math.nan, *rows[0][1:]), (*rows[0][:3], -1.0, *rows[0][4:])]
    file = tmp_path / "b.splat"
    file.write_bytes(b"".join(struct.pack("<6f8B", *row) for row in rows))
    read = read_gaussians(file).gaussians
    assert read.means.tolist() == [[1.0, 2.0, -3.0]]
    torch.testing.assert_close(read.log_scales[0, :2].exp(), torch.tensor([0.5, 0.25]))
    assert float(read.log_scales[0, 2].exp()) < 1e-20
    torch.testing.assert_close(0.5 + 0.28209479 * read.colors[0], torch.tensor([1.0, 0.0, 128 / 255]))
    torch.testing.assert_close(read.rotations[0], torch.tensor([0.0, 127 / 128, 0.0, 0.0]))
    assert float(read.logits.sigmoid()) == pytest.approx(64 / 255)


@pytest.mark.parametrize("size", [0, 31, 33])
def test_what_is_no_splat_is_refused(tmp_path: Path, size: int) -> None:
    (tmp_path / "a.splat").write_bytes(bytes(size))
    with pytest.raises(DataError, match=r"a\.splat .*\d+ bytes"):
        read_gaussians(tmp_path / "a.splat")


@pytest.mark.parametrize("colors", [True, False])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_compressed_ply(tmp_path: Path, degree: int, colors: bool) -> None:
    """Half a step: of 10 or 11 bits between a chunk's ends, of 8 bits, of 1/32 of a harmonic; a fifth of a degree."""
    given = some(600, degree)
    given.colors.clamp_(-1.7, 1.7)
    write_compressed(tmp_path / "a.ply", given, colors)
    read, look = read_gaussians(tmp_path / "a.ply")
    assert look == ELSEWHERE
    assert read.degree == degree
    steps = torch.tensor([2047.0, 1023.0, 2047.0])
    for name in ("means", "log_scales"):
        one, other = getattr(read, name), getattr(given, name)
        for start in range(0, 600, 256):
            chunk = slice(start, start + 256)
            step = (other[chunk].amax(0) - other[chunk].amin(0)) / steps
            assert bool(((one[chunk] - other[chunk]).abs() <= 0.51 * step + 1e-5).all()), name
    assert float((read.logits.sigmoid() - given.logits.sigmoid()).abs().max()) <= 0.5 / 255 + 1e-6
    spread = float(given.colors.amax() - given.colors.amin()) if colors else 1 / 0.28209
    assert float((read.colors - given.colors).abs().max()) <= 0.51 * spread / 255
    assert float(angles(read, given).max()) < 0.2
    if degree:
        assert float((read.harmonics - given.harmonics).abs().max()) <= 1 / 64 + 1e-6


def test_compressed_ply_says_how_it_is_drawn(tmp_path: Path) -> None:
    write_compressed(tmp_path / "a.ply", some(5), comments=("SplatRenderMode: mip",))
    assert read_gaussians(tmp_path / "a.ply").look == replace(ELSEWHERE, antialiased=True)


def test_damaged_compressed_ply_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.ply"
    write_compressed(file, some(300, 1))
    whole = file.read_bytes()
    damages = {
        "chunks of 256 for 300 Gaussians": (b"element chunk 2", b"element chunk 1"),
        "without packed_scale": (b"packed_scale", b"packed_sxale"),
        "without min_x": (b"float min_x", b"float win_x"),
        "bytes of harmonics for 300 of 300": (b"property uchar f_rest_8\n", b""),
        "without f_rest_3": (b"f_rest_3", b"f_rest_x"),
        "without packed_color": (b"uint packed_color", b"float packed_color"),
        "without max_z": (b"float max_z", b"uint max_z"),
        "without f_rest_5": (b"uchar f_rest_5", b"char f_rest_5"),
        "truncated": (b"element chunk 2\n", b"element chunk 999999999999999\n"),
    }
    for words, (old, new) in damages.items():
        assert whole.count(old) == 1
        file.write_bytes(whole.replace(old, new))
        with pytest.raises(DataError, match=words):
            read_gaussians(file)
    for size in range(whole.index(b"end_header") + 11, len(whole), 371):
        file.write_bytes(whole[:size])
        with pytest.raises(DataError, match="truncated"):
            read_gaussians(file)
    # A file of 300 Gaussians that states 10^17 does not ask for memory for them.
    many = whole.replace(b"element chunk 2\n", b"element chunk 999999999999999\n")
    file.write_bytes(many.replace(b"element vertex 300\n", b"element vertex 100000000000000000\n"))
    with pytest.raises(DataError, match="truncated"):
        read_gaussians(file)


def ply(
    gaussians: Gaussians, extra: dict[str, list[float]], comments: tuple[str, ...] = (), without: str = ""
) -> bytes:
    """An ascii PLY file with further properties."""
    terms = gaussians.harmonics.shape[2]
    names = [name for name in property_names(terms) if not name.startswith("n")]
    parts = [gaussians.means, gaussians.colors, gaussians.harmonics.flatten(1), gaussians.logits[:, None]]
    table = torch.cat([*parts, gaussians.log_scales, gaussians.rotations], -1).T.tolist()
    columns = {name: column for name, column in zip(names, table, strict=True) if name != without} | extra
    lines = ["ply", "format ascii 1.0", *(f"comment {text}" for text in comments), f"element vertex {len(gaussians)}"]
    lines += [*(f"property float {name}" for name in columns), "end_header"]
    return "\n".join([*lines, *(" ".join(map(repr, row)) for row in zip(*columns.values(), strict=True)), ""]).encode()


@pytest.mark.parametrize("name", ["filter_3D", "filter_3d"])
def test_the_filter_of_mip_splatting_is_a_part_of_the_gaussian(tmp_path: Path, name: str) -> None:
    """Its covariance grows by a ball's, and its light, opacity times the root of the determinant, stays."""
    given = some(40, 1).map(lambda values: values.clone())
    filters = torch.rand(40, generator=torch.Generator().manual_seed(3)) * 0.1
    filters[0] = 0.0
    file = tmp_path / "m.ply"
    file.write_bytes(ply(given, {name: filters.tolist()}))
    read, look = read_gaussians(file)
    assert look == MIP_SPLATTING
    larger = covariances(given) + filters.double().square()[:, None, None] * torch.eye(3)
    torch.testing.assert_close(covariances(read), larger, rtol=1e-5, atol=1e-9)

    def light(gaussians: Gaussians, covariance: torch.Tensor) -> torch.Tensor:
        return gaussians.logits.double().sigmoid() * torch.linalg.det(covariance).sqrt()

    torch.testing.assert_close(light(read, larger), light(given, covariances(given)), rtol=1e-4, atol=0)
    torch.testing.assert_close(read.logits[0], given.logits[0], rtol=1e-5, atol=1e-5)
    file.write_bytes(ply(given, {name: filters.tolist()}, ("SplatRenderMode: default", "SplatBlur: 0.3")))
    assert read_gaussians(file).look == ELSEWHERE  # the file decides


def test_discs_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "discs.ply"
    file.write_bytes(ply(some(4), {}, without="scale_2"))
    with pytest.raises(DataError, match=r"discs\.ply .*2D Gaussian Splatting"):
        read_gaussians(file)
    file.write_bytes(ply(some(4), {}, ("SplatRenderMode: 2dgs",)))
    with pytest.raises(DataError, match=r"discs of 2D Gaussian Splatting"):
        read_gaussians(file)


@pytest.mark.parametrize(
    ("suffix", "program"), [(".glb", "glTF"), (".splatv", "antimatter15/splaTV"), (".rad", "Spark")]
)
def test_other_formats_are_named(tmp_path: Path, suffix: str, program: str) -> None:
    file = (tmp_path / "a").with_suffix(suffix)
    file.write_bytes(bytes(100))
    assert is_splat_file(file)
    with pytest.raises(DataError, match=f"is of {program}'s format; Gaussians are read from"):
        read_gaussians(file)


COMMENTS = {
    ("Exported from Brush", "Vertical axis: y", "SH degree: 3", "SplatRenderMode: mip"): replace(
        ELSEWHERE, antialiased=True
    ),
    ("SplatRenderMode: default",): ELSEWHERE,
    ("  SPLATRENDERMODE:  Mip ",): replace(ELSEWHERE, antialiased=True),
    ("SplatRenderMode: mip-0.1",): MIP_SPLATTING,
    ("antialiased 1",): replace(ELSEWHERE, antialiased=True),
    ("antialiased 0",): ELSEWHERE,
    ("SplatRenderMode: default", "SplatSort: distance"): OURS,
    (): ELSEWHERE,
}
"""Settings of drawing in a file."""


@pytest.mark.parametrize("comments", COMMENTS)
def test_comments(tmp_path: Path, comments: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.ply").write_bytes(ply(some(3), {}, comments))
    assert read_gaussians(tmp_path / "a.ply").look == COMMENTS[comments]
    assert "warning" not in capsys.readouterr().err


NOT_KNOWN = (
    "SplatRenderMode: banana",
    "SplatRenderMode: mip-",
    "SplatSort: colour",
    "SplatBlur: nan",
    "SplatBlur: 1e9",
)


@pytest.mark.parametrize("comment", NOT_KNOWN)
def test_comments_that_are_not_known_are_said(tmp_path: Path, comment: str, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.ply").write_bytes(ply(some(3), {}, (comment,)))
    assert read_gaussians(tmp_path / "a.ply").look == ELSEWHERE
    said = capsys.readouterr().err
    assert comment.split()[1] in said
    assert "a.ply" in said
    assert said.count("\n") == 1

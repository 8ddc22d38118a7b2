"""PLY files: every kind of number, with any other content; and no trust in a header's claims."""

import struct
from pathlib import Path

import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.data.ply import read_points, write_points

POINTS = [(1.0, 2.0, 3.0), (-0.5, 0.25, 1e3)]
EXPECTED = torch.tensor(POINTS, dtype=torch.float64)


def header(kind: str, count: int = 2, properties: str = "float x,float y,float z", more: str = "") -> bytes:
    lines = ["ply", f"format {kind} 1.0", "comment by hand", f"element vertex {count}"]
    lines += [f"property {part}" for part in properties.split(",")]
    return ("\n".join([*lines, *filter(None, [more]), "end_header"]) + "\n").encode()


def write(folder: Path, content: bytes) -> Path:
    file = folder / "points.ply"
    file.write_bytes(content)
    return file


def test_ascii(tmp_path: Path) -> None:
    body = "\n".join(" ".join(map(str, point)) for point in POINTS).encode()
    assert torch.equal(read_points(write(tmp_path, header("ascii") + body)), EXPECTED)


@pytest.mark.parametrize(("kind", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_binary_with_colours_between_and_faces_after(tmp_path: Path, kind: str, order: str) -> None:
    properties = "uchar red,double z,float32 y,int16 label,double x"
    body = b"".join(struct.pack(f"{order}Bdfhd", 7, z, y, -3, x) for x, y, z in POINTS)
    head = header(kind, 2, properties, "element face 1\nproperty list uchar int vertex_indices")
    assert torch.equal(read_points(write(tmp_path, head + body + b"\x03" + 12 * b"\0")), EXPECTED)


def test_points_that_are_nowhere_are_left_out(tmp_path: Path) -> None:
    assert torch.equal(read_points(write(tmp_path, header("ascii", 3) + b"1 2 3\nnan 0 0\n-0.5 0.25 1e3")), EXPECTED)


def test_no_points(tmp_path: Path) -> None:
    assert read_points(write(tmp_path, header("ascii", 0))).shape == (0, 3)


BAD = {
    "empty": (b"", "not a PLY file"),
    "an image": (b"\x89PNG\r\n\x1a\n" + 100 * b"\0", "not a PLY file"),
    "no end": (b"ply\nformat ascii 1.0\n", "its header has no 'end_header'"),
    "endless line": (b"ply\nformat ascii 1.0\ncomment " + 5000 * b"a", "its header has no 'end_header'"),
    "unknown format": (header("middle_endian"), "its format is 'middle_endian'"),
    "no z": (header("ascii", 2, "float x,float y"), "vertices must have the properties x, y and z"),
    "x twice": (
        header("ascii", 2, "float x,float x,float y,float z"),
        "vertices must have the properties x, y and z, each once",
    ),
    "a list": (header("ascii", 2, "list uchar int x"), "is not supported"),
    "unknown type": (header("ascii", 2, "quad x"), "property 'quad x'"),
    "negative count": (header("ascii", -2), "'vertex' comes first"),
    "faces first": (header("ascii").replace(b"element v", b"element face 3\nelement v"), "'face' comes first"),
    "more than there is": (header("binary_little_endian", 10**12) + 24 * b"\0", "is truncated"),
    "more than there is, ascii": (header("ascii", 10**12) + b"1 2 3\n", "is truncated"),
    "truncated": (header("binary_little_endian", 3) + 24 * b"\0", "is truncated"),
    "short line": (header("ascii") + b"1 2 3\n1 2\n   \n", "point 1 has 2 values instead of 3"),
    "words": (header("ascii") + b"1 2 3\nx y z\n", "a value of point 1 is not a number"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_in_one_line(tmp_path: Path, name: str) -> None:
    content, words = BAD[name]
    file = write(tmp_path, content)
    with pytest.raises(DataError, match=words) as error:
        read_points(file)
    assert str(file) in str(error.value)
    assert "\n" not in str(error.value)


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot read"):
        read_points(tmp_path / "none.ply")


@pytest.mark.parametrize("normals", [None, torch.tensor([[0.0, 0.6, -0.8], [1.0, 0.0, 0.0]])])
def test_written_numbers_stand_under_their_own_names(tmp_path: Path, normals: torch.Tensor | None) -> None:
    """The format's definition has a line of the header for each property, in the order of the numbers."""
    colors = torch.tensor([[1.0, 0.5, 0.0], [-0.1, 0.2, 1.3]])
    file = tmp_path / "points.ply"
    write_points(file, EXPECTED.float(), colors, normals)
    head, _, body = file.read_bytes().partition(b"end_header\n")
    lines = [line.split() for line in head.decode().splitlines()]
    assert lines[:3] == [["ply"], ["format", "binary_little_endian", "1.0"], ["element", "vertex", "2"]]
    properties = [words[1:] for words in lines[3:]]
    row = struct.Struct("<" + "".join({"float": "f", "uchar": "B"}[kind] for kind, _ in properties))
    assert len(body) == 2 * row.size
    rows = [dict(zip([name for _, name in properties], values, strict=True)) for values in row.iter_unpack(body)]
    bytes_of = [(255, 128, 0), (0, 51, 255)]
    for number, found in enumerate(rows):
        expected = dict(zip("xyz", POINTS[number], strict=True))
        expected |= dict(zip(("red", "green", "blue"), bytes_of[number], strict=True))
        if normals is not None:
            expected |= dict(zip(("nx", "ny", "nz"), normals[number].tolist(), strict=True))
        assert found == expected

"""Gaussians read in parts equal Gaussians read at once."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.data.ply import read_columns, read_header, write_columns
from nerfloom.splats.files import read_gaussians, stream_gaussians, write_gaussians
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import Look, comments
from tests.splats.foreign_files import write_compressed, write_splat
from tests.splats.test_files import same, some


@pytest.mark.parametrize("name", ["a.ply", "a.spz", "a.sog", "a.compressed.ply", "a.splat"])
@pytest.mark.parametrize("most", [7, 50, 1000])
def test_parts_are_the_whole(tmp_path: Path, name: str, most: int) -> None:
    file, given = tmp_path / name, some(50, 0 if name.endswith("splat") else 2)
    others = {"a.compressed.ply": write_compressed, "a.splat": write_splat}
    if name in others:
        others[name](file, given)
    else:
        write_gaussians(file, given, look=Look(True, 0.5))
    whole, stream = read_gaussians(file), stream_gaussians(file)
    assert stream.look == whole.look
    for _ in range(2):  # as often as asked
        parts = list(stream.parts(most))
        assert [len(part) for part in parts] == [min(most, 50 - first) for first in range(0, 50, most)]
        assert same(Gaussians.joined(parts), whole.gaussians)


def test_parts_of_mip_splatting_in_double_precision_and_in_ascii(tmp_path: Path) -> None:
    """A filter, doubles, and rows that cannot be drawn, which are left to the reader."""
    given = some(20, 1)
    given.means[3] = torch.nan
    write_gaussians(tmp_path / "a.ply", given)
    header = read_header(tmp_path / "a.ply")
    vertex = header.elements["vertex"]
    columns = dict(zip(vertex.names, read_columns(tmp_path / "a.ply", vertex, vertex.names), strict=True))
    columns |= {axis: columns[axis].astype(np.float64) for axis in "xyz"}
    columns["filter_3D"] = np.linspace(0.01, 0.2, 20, dtype=np.float32)
    write_columns(tmp_path / "b.ply", list(columns.items()), comments=comments(Look(True, 0.1)))
    whole, stream = read_gaussians(tmp_path / "b.ply"), stream_gaussians(tmp_path / "b.ply")
    found = Gaussians.joined(list(stream.parts(6)))
    assert len(found) == 20
    assert found.means.dtype == torch.float64
    assert same(found[found.drawable()], whole.gaussians)
    assert stream.look == whole.look
    names = " ".join(f"property float {name}\n" for name in columns).replace(" property", "property")
    rows = "\n".join(" ".join(f"{columns[name][row]:.9g}" for name in columns) for row in range(20))
    text = f"ply\nformat ascii 1.0\nelement vertex 20\n{names}end_header\n{rows}\n"
    (tmp_path / "c.ply").write_text(text)
    ascii_found = Gaussians.joined(list(stream_gaussians(tmp_path / "c.ply").parts(6)))
    torch.testing.assert_close(ascii_found.log_scales, whole.gaussians.log_scales, rtol=1e-5, atol=1e-5)


def test_a_truncated_file_is_refused_where_it_ends(tmp_path: Path) -> None:
    file = tmp_path / "a.ply"
    write_gaussians(file, some(50))
    file.write_bytes(file.read_bytes()[:-10])
    parts = stream_gaussians(file).parts(20)
    assert [len(next(parts)), len(next(parts))] == [20, 20]
    with pytest.raises(DataError, match="truncated"):
        next(parts)
    for name in ("b.ply", "c.txt"):
        (tmp_path / name).write_bytes(b"ply\nformat" if name == "b.ply" else b"nothing")
        with pytest.raises(DataError, match=name.replace(".", r"\.")):
            stream_gaussians(tmp_path / name)


def test_drawable_ones_are_finite_and_have_a_rotation() -> None:
    given = some(6)
    given.means[0, 1] = torch.inf
    given.log_scales[1, 0] = 100.0  # its exponential is infinite
    given.rotations[2] = 0
    bad = replace(given, harmonics=given.harmonics.clone())
    bad.harmonics[3, 0, 0] = torch.nan
    assert given.drawable().tolist() == [False, False, False, True, True, True]
    assert bad.drawable().tolist() == [False, False, False, False, True, True]
    assert [len(part) for part in given.sliced(4)] == [4, 2]

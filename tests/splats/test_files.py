"""Files of Gaussians: bytes written by hand are the truth, damage is refused in a line, limits of size hold."""

import gzip
import math
import struct
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError, DataError
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.scale import Scale
from nerfloom.cli.export import main
from nerfloom.data.offsets import offset_file, read_offset
from nerfloom.data.ply import read_columns, read_header, write_columns
from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics_reference
from nerfloom.splats.files import READ, SUFFIXES, read_gaussians, write_gaussians
from nerfloom.splats.gaussian_limit import colour_error, fitted_ply, fitted_spz, visibility
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import OURS, Look
from nerfloom.splats.ply import MAX_LOGIT, ply_size, property_names, write_ply
from nerfloom.splats.spz import SIGNS, encoded, fractional_bits
from nerfloom.splats.spz_container import COMMENT_START
from nerfloom.splats.transform import quaternion, quaternion_product, rotated_harmonics, transformed
from tests.conftest import Refused

TERMS = (0, 3, 8, 15)
NAMES = ("means", "log_scales", "rotations", "logits", "colors", "harmonics")


def some(count: int = 50, degree: int = 3, seed: int = 0) -> Gaussians:
    random = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(count, *shape, generator=random)

    return Gaussians(
        5 * normal(3), 0.7 * normal(3) - 3, normal(4), 2 * normal(), normal(3), 0.2 * normal(3, TERMS[degree])
    )


def gaussians_in(file: Path) -> Gaussians:
    return read_gaussians(file).gaussians


def same(first: Gaussians, second: Gaussians) -> bool:
    return all(torch.equal(getattr(first, name), getattr(second, name)) for name in NAMES)


def matrices(quaternions: Tensor) -> Tensor:
    """Rotation matrices (N, 3, 3), from the textbook's formula."""
    w, x, y, z = (quaternions.double() / quaternions.double().norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def covariances(gaussians: Gaussians) -> Tensor:
    axes = matrices(gaussians.rotations) * gaussians.log_scales.double().exp()[:, None]
    return axes @ axes.mT


def published(direction: Tensor) -> Tensor:
    """The 15 harmonics of degrees 1 to 3 at a direction, as the papers' polynomials are in 3D Gaussian Splatting."""
    x, y, z = direction.tolist()
    xx, yy, zz = x * x, y * y, z * z
    c1, c2 = 0.4886025119029199, (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
    c3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)
    values = [-c1 * y, c1 * z, -c1 * x]
    values += [c2[0] * x * y, -c2[0] * y * z, c2[1] * (2 * zz - xx - yy), -c2[0] * x * z, c2[2] * (xx - yy)]
    values += [-c3[0] * y * (3 * xx - yy), c3[1] * x * y * z, -c3[2] * y * (4 * zz - xx - yy)]
    values += [c3[3] * z * (2 * zz - 3 * xx - 3 * yy), -c3[2] * x * (4 * zz - xx - yy), c3[4] * z * (xx - yy)]
    return torch.tensor([*values, -c3[0] * x * (xx - 3 * yy)], dtype=torch.float64)


def seen(gaussians: Gaussians, direction: Tensor) -> Tensor:
    """Colours (N, 3) from a direction, less the constant part."""
    return gaussians.harmonics.double() @ published(direction)[: gaussians.harmonics.shape[2]]


def directions(count: int = 20) -> Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(1)).double())


def turn(seed: int = 2) -> Tensor:
    random = torch.randn(3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    q = torch.linalg.qr(random)[0]
    return q * torch.linalg.det(q)


def test_harmonics_have_the_signs_of_the_published_code() -> None:
    for direction in directions():
        ours = spherical_harmonics_reference(direction[None], 4)[0, 1:]
        torch.testing.assert_close(ours, published(direction), atol=1e-14, rtol=0)


# -- PLY ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", range(4))
def test_ply_is_exact(tmp_path: Path, degree: int) -> None:
    gaussians = some(degree=degree)
    assert write_gaussians(tmp_path / "a.ply", gaussians) == []
    assert same(gaussians_in(tmp_path / "a.ply"), gaussians)
    assert (tmp_path / "a.ply").stat().st_size == ply_size(50, TERMS[degree])


def test_ply_has_the_published_layout(tmp_path: Path) -> None:
    gaussians = some(3, degree=1)
    write_ply(tmp_path / "a.ply", gaussians)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"] + [f"f_rest_{i}" for i in range(9)]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        "comment SplatRenderMode: default",
        "comment SplatSort: distance",
    ]
    lines += ["element vertex 3", *[f"property float {n}" for n in names]]
    header = ("\n".join([*lines, "end_header"]) + "\n").encode()
    content = (tmp_path / "a.ply").read_bytes()
    assert content[: len(header)] == header
    rows = [struct.unpack("<26f", content[len(header) + 104 * i :][:104]) for i in range(3)]
    for index, row in enumerate(rows):
        g = gaussians[index : index + 1].map(lambda values: values[0])
        expected = [*g.means, 0, 0, 0, *g.colors, *g.harmonics.flatten(), g.logits, *g.log_scales, *g.rotations]
        assert row == tuple(map(float, expected))
    assert row[9:12] == tuple(gaussians.harmonics[2, 0].tolist())  # red before green


KINDS = {"float": "f", "double": "d", "int": "i"}


def by_hand(gaussians: Gaussians, order: str = "<", terms: int | None = None, kind: str = "float") -> bytes:
    """A PLY file of shuffled properties without normals, with two others and faces behind."""
    terms = gaussians.harmonics.shape[2] if terms is None else terms
    names = [name for name in property_names(terms) if name not in ("nx", "ny", "nz")]
    table = torch.zeros(len(gaussians), 3, terms)
    table[:, :, : gaussians.harmonics.shape[2]] = gaussians.harmonics
    parts = [gaussians.means, gaussians.colors, table.flatten(1), gaussians.logits[:, None], gaussians.log_scales]
    values = dict(zip(names, torch.cat([*parts, gaussians.rotations], -1).T.tolist(), strict=True))
    columns = [("label", "int", [7] * len(gaussians))] + [(name, kind, values[name]) for name in reversed(names)]
    columns.insert(5, ("quality", "double", [math.nan] * len(gaussians)))
    form = {"<": "binary_little_endian", ">": "binary_big_endian", "": "ascii"}[order]
    lines = ["ply", f"format {form} 1.0", "comment by hand", f"element vertex {len(gaussians)}"]
    lines += [f"property {kind} {name}" for name, kind, _ in columns]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    rows = list(zip(*[column for _, _, column in columns], strict=True))
    if not order:
        return "\n".join([*lines, *(" ".join(map(repr, row)) for row in rows), "3 0 1 2\n"]).encode()
    code = order + "".join(KINDS[kind] for _, kind, _ in columns)
    return "\n".join([*lines, ""]).encode() + b"".join(struct.pack(code, *row) for row in rows) + b"\x03" + 12 * b"\0"


@pytest.mark.parametrize("kind", ["float", "double"])
@pytest.mark.parametrize("order", ["<", ">", ""])
@pytest.mark.parametrize("degree", [0, 2, 3])
def test_ply_of_other_programs(tmp_path: Path, degree: int, order: str, kind: str) -> None:
    gaussians = some(7, degree)
    (tmp_path / "b.dat").write_bytes(by_hand(gaussians, order, kind=kind))
    assert same(gaussians_in(tmp_path / "b.dat"), gaussians)


def test_degree_4_is_cut_to_3(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gaussians = some(7)
    (tmp_path / "b.ply").write_bytes(by_hand(gaussians, terms=24))
    assert same(gaussians_in(tmp_path / "b.ply"), gaussians)
    assert "harmonics above degree 3 are left out" in capsys.readouterr().err


def test_what_cannot_be_rendered_is_left_out_and_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gaussians = some(9)
    gaussians.means[0, 1] = math.nan
    gaussians.harmonics[1, 2, 14] = math.inf
    gaussians.rotations[2] = 0
    gaussians.log_scales[3, 0] = 100  # its exponential is infinite
    gaussians.logits[4], gaussians.logits[5] = math.inf, -math.inf  # opacities 1 and 0 of other programs
    write_ply(tmp_path / "a.ply", gaussians)
    read = gaussians_in(tmp_path / "a.ply")
    assert "4 of 9 Gaussians" in capsys.readouterr().err
    assert torch.equal(read.means, gaussians.means[4:])
    assert read.logits[:2].tolist() == [MAX_LOGIT, -MAX_LOGIT]
    gaussians.means[:] = math.nan
    write_ply(tmp_path / "a.ply", gaussians)
    with pytest.raises(DataError, match="none of its 9 Gaussians is finite"):
        gaussians_in(tmp_path / "a.ply")


@pytest.mark.parametrize("ending", SUFFIXES)
def test_flat_gaussians_of_other_programs(tmp_path: Path, ending: str) -> None:
    # Programs that make discs write the size 0 along the third axis, with an infinite logarithm.
    gaussians = some(9, 0)
    gaussians.log_scales[4:, 2] = -math.inf
    write_ply(tmp_path / "a.ply", gaussians)
    read = gaussians_in(tmp_path / "a.ply")
    assert torch.equal(read.log_scales[:, :2], gaussians.log_scales[:, :2])
    assert (read.log_scales[4:, 2] < -20).all()
    write_gaussians(file := tmp_path / f"b{ending}", read)
    if ending in READ:
        sizes = gaussians_in(file).log_scales.sort(-1).values  # some formats have another order
        largest = [one.log_scales.amax(-1).sort().values for one in (gaussians_in(file), read)]
        assert torch.allclose(*largest, atol=0.1)
        assert int((sizes[:, 0] < -9.9).sum()) == 5


def refused_in_a_line(file: Path, content: bytes) -> str:
    file.write_bytes(content)
    with pytest.raises(DataError) as error:
        gaussians_in(file)
    assert str(file) in str(error.value)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_damaged_ply_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.ply"
    whole = by_hand(some(40))
    assert "no Gaussians: rot_0 is missing" in refused_in_a_line(file, whole.replace(b" rot_0", b" turn0"))
    cloud = (
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    assert "has points, but no Gaussians: f_dc_0, f_dc_1" in refused_in_a_line(file, cloud + b"1 2 3\n")
    assert "44 properties f_rest" in refused_in_a_line(file, whole.replace(b" f_rest_7\n", b" f_last_7\n"))
    assert "45 properties f_rest" in refused_in_a_line(file, whole.replace(b" f_rest_7\n", b" f_rest_x\n"))
    assert "it holds no Gaussians" in refused_in_a_line(file, whole.replace(b"vertex 40", b"vertex 0"))
    assert "truncated" in refused_in_a_line(file, whole.replace(b"vertex 40", b"vertex 40000000000000"))
    assert "no file of Gaussians" in refused_in_a_line(file, b"\x89PNG")
    with pytest.raises(DataError, match="cannot read"):
        gaussians_in(tmp_path / "none.ply")
    with pytest.raises(DataError, match="cannot read"):
        gaussians_in(tmp_path)


@pytest.mark.parametrize("suffix", [".ply", ".spz", ".sog", ".glb"])
def test_a_full_disk_leaves_the_file_that_was_there(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / f"a{suffix}"
    write_gaussians(file, some(20))
    before = file.read_bytes()
    monkeypatch.setattr("os.fsync", lambda number: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(OSError, match="No space left"):
        write_gaussians(file, some(30))
    assert file.read_bytes() == before
    assert list(tmp_path.iterdir()) == [file]


def test_truncated_ply_is_refused_wherever_it_ends(tmp_path: Path) -> None:
    write_ply(tmp_path / "whole.ply", some(100))
    whole = (tmp_path / "whole.ply").read_bytes()
    for size in [*range(0, len(whole), 997), len(whole) - 1]:
        assert "a.ply" in refused_in_a_line(tmp_path / "a.ply", whole[:size]), size


# -- SPZ ------------------------------------------------------------------------------------------------------------


def packed(version: int, count: int, degree: int, body: bytes, fraction: int = 8, flags: int = 0) -> bytes:
    return gzip.compress(struct.pack("<IIIBBBB", 0x5053474E, version, count, degree, fraction, flags, 0) + body)


def body(rotation: bytes, harmonics: bytes = b"") -> bytes:
    """One Gaussian at (1.5, -2, 0.25) of SPZ's axes, opacity 51/255, scales -10, 0 and 2."""
    positions = b"".join(round(value * 256).to_bytes(3, "little", signed=True) for value in (1.5, -2, 0.25))
    return positions + bytes([51, 255, 0, 51, 0, 160, 192]) + rotation + harmonics


def test_version_2_by_hand(tmp_path: Path) -> None:
    """The order of arrays, the axes, and the order of coefficients: red, green and blue are neighbours."""
    harmonics = bytes([128 + 8 * index for index in range(9)])
    (tmp_path / "a.spz").write_bytes(packed(2, 1, 1, body(bytes([255, 127, 128]), harmonics)))
    g = gaussians_in(tmp_path / "a.spz")
    assert g.means.tolist() == [[1.5, 2.0, -0.25]]
    assert g.log_scales.tolist() == [[-10.0, 0.0, 2.0]]
    assert float(g.logits.sigmoid()) == pytest.approx(0.2)
    assert g.colors[0].tolist() == pytest.approx([0.5 / 0.15, -0.5 / 0.15, -0.3 / 0.15])
    small = 0.5 / 127.5
    assert g.rotations[0].tolist() == pytest.approx([0, 1, small, -small], abs=1e-6)
    steps = torch.tensor([[0.0, 3, 6], [1, 4, 7], [2, 5, 8]]) / 16
    assert torch.equal(g.harmonics[0], steps * torch.tensor([-1.0, -1, 1]))


@pytest.mark.parametrize("largest", range(4))
def test_version_3_by_hand(tmp_path: Path, largest: int) -> None:
    """Which of x, y, z, w is left out, then signs and magnitudes of the others from the highest bits down."""
    word = largest << 30 | (1 << 9 | 100) << 20 | 200 << 10 | (1 << 9 | 300)
    (tmp_path / "a.spz").write_bytes(packed(3, 1, 0, body(struct.pack("<I", word))))
    xyzw = [sign * value / 511 / math.sqrt(2) for sign, value in ((-1, 100), (1, 200), (-1, 300))]
    xyzw.insert(largest, math.sqrt(1 - sum(value * value for value in xyzw)))
    x, y, z, w = xyzw
    assert gaussians_in(tmp_path / "a.spz").rotations[0].tolist() == pytest.approx([w, x, -y, -z], abs=1e-6)


def test_largest_of_a_damaged_rotation_is_finite(tmp_path: Path) -> None:
    (tmp_path / "a.spz").write_bytes(packed(3, 1, 0, body(b"\xff\xff\xff\x3f")))
    assert bool(gaussians_in(tmp_path / "a.spz").rotations.isfinite().all())


@pytest.mark.parametrize("degree", range(4))
def test_spz_is_as_exact_as_its_bits(tmp_path: Path, degree: int) -> None:
    gaussians = some(3000, degree)
    gaussians.colors[7, 1] = -4
    said = write_gaussians(tmp_path / "a.spz", gaussians)
    rows = zip(gaussians.colors.tolist(), gaussians.harmonics.flatten(1).tolist(), strict=True)
    beyond = sum(max(map(abs, color)) > 1 / 0.3 or max(map(abs, rest), default=0) > 1 for color, rest in rows)
    assert len(said) == 1
    assert f" up to 1: {beyond:,} of the Gaussians" in said[0]
    read = gaussians_in(tmp_path / "a.spz")
    assert float((read.means - gaussians.means).abs().max()) <= 0.5 / 4096 + 1e-6
    assert float((read.logits.sigmoid() - gaussians.logits.sigmoid()).abs().max()) <= 0.5 / 255 + 1e-6
    inside = gaussians.colors.abs() < 3.3
    assert float((read.colors - gaussians.colors)[inside].abs().max()) <= 0.5 / 255 / 0.15 + 1e-6
    for band, bits in ((slice(0, 3), 5), (slice(3, 15), 4)):
        off = (read.harmonics - gaussians.harmonics.clamp(-1, 127 / 128))[:, :, band].abs()
        assert not off.numel() or float(off.max()) <= 2.0**-bits + 1e-6
    # Axes may be exchanged: sizes and orientations are compared as covariances, and axis by axis once sorted.
    sizes, expected = read.log_scales.sort(-1).values, gaussians.log_scales.sort(-1).values
    assert float((sizes - expected).abs().max()) <= 1 / 32 + 1e-6
    exact = covariances(gaussians)
    relative = (covariances(read) - exact).abs().amax((1, 2)) / exact.abs().amax((1, 2))
    assert float(relative.max()) < 2 / 32 + 2 * math.radians(1)


def test_written_rotations_are_off_by_a_degree_at_most(tmp_path: Path) -> None:
    """Sizes of an integer number of steps, so that orientation alone is rounded."""
    gaussians = some(20_000, 0)
    gaussians.log_scales[:] = torch.tensor([-6.0, -4.0, -2.0])
    (tmp_path / "a.spz").write_bytes(encoded(gaussians))
    read = gaussians_in(tmp_path / "a.spz")
    assert float(read.rotations[:, 0].min()) > 0.84
    order = read.log_scales.argsort(-1)
    axes = matrices(read.rotations).gather(2, order[:, None].expand(-1, 3, -1))
    cosines = (axes * matrices(gaussians.rotations)).sum(1).abs().clamp(max=1)
    assert float(cosines.acos().rad2deg().max()) < 1.0


def test_spz_looks_like_the_ply_of_the_same_scene(tmp_path: Path) -> None:
    """Harmonics in multiples of a step, so that nothing but the axes' signs can make a difference."""
    gaussians = some(30)
    gaussians.harmonics[:] = (gaussians.harmonics * 8).round() / 8
    write_gaussians(tmp_path / "a.ply", gaussians)
    write_gaussians(tmp_path / "a.spz", gaussians)
    ply, spz = gaussians_in(tmp_path / "a.ply"), gaussians_in(tmp_path / "a.spz")
    for direction in directions(5):
        torch.testing.assert_close(seen(spz, direction), seen(ply, direction))
    # The file itself has y and z turned around, so the turned d shows the colour of d.
    signs = torch.tensor(SIGNS).double()
    for direction in directions(5):
        turned = published(direction * torch.tensor([1.0, -1, -1]).double())
        torch.testing.assert_close(turned, signs * published(direction))


def test_positions_use_as_many_bits_as_they_need() -> None:
    gaussians = some(100)
    assert fractional_bits(gaussians) == 12
    small = transformed(gaussians, torch.eye(3), 1e-3, torch.zeros(3))
    assert fractional_bits(small) > 18
    far = Gaussians(**{**vars(gaussians), "means": gaussians.means.clone()})
    far.means[0, 0] = 2.0**20
    assert fractional_bits(far) == 2
    far.means[0, 0] = 2.0**23
    with pytest.raises(ConfigError, match="write a PLY file"):
        encoded(far)


def test_what_is_out_of_range_is_said(tmp_path: Path) -> None:
    gaussians = some(100)
    gaussians.colors.clamp_(-3, 3)
    gaussians.harmonics.clamp_(-1, 1)
    gaussians.means[0, 0] = 2.0**20
    gaussians.log_scales[:5] = -12
    gaussians.log_scales[5:9] = torch.tensor([-3.0, -3.0, -12.0])  # flat: how thin is not seen
    first, second = write_gaussians(tmp_path / "a.spz", gaussians)
    assert "rounds positions to 0.25" in first
    assert "5 of the Gaussians get the nearest" in second
    assert bool(gaussians_in(tmp_path / "a.spz").log_scales[:5].eq(-10).all())
    gaussians.log_scales[:9, 0] = torch.tensor([*(5 * [-4.0]), 5.96, 5.98, 7.0, -4.0])  # the most is 255 / 16 - 10
    (_, large) = write_gaussians(tmp_path / "a.spz", gaussians)
    assert "to 379: 2 of the Gaussians" in large


def test_opacities_of_0_and_1_stay_finite(tmp_path: Path) -> None:
    gaussians = some(2, 0)
    gaussians.logits[:] = torch.tensor([100.0, -100.0])
    (tmp_path / "a.spz").write_bytes(encoded(gaussians))
    assert gaussians_in(tmp_path / "a.spz").logits.sigmoid().tolist() == pytest.approx([1019 / 1020, 1 / 1020])


def test_extensions_behind_the_arrays_are_passed_over(tmp_path: Path) -> None:
    content = body(bytes([255, 127, 128])) + struct.pack("<II", 0xADBE0002, 12) + 12 * b"\0"
    (tmp_path / "a.spz").write_bytes(packed(2, 1, 0, content, flags=2))
    assert len(gaussians_in(tmp_path / "a.spz")) == 1
    for axes in (4, 6):  # right, up and back, which are usual; and right, down and front
        extended = content + struct.pack("<III", 0xADBE0003, 4, axes)
        (tmp_path / "a.spz").write_bytes(packed(2, 1, 0, extended, flags=2))
        if axes == 4:
            assert len(gaussians_in(tmp_path / "a.spz")) == 1
        else:
            with pytest.raises(DataError, match=r"a\.spz has axes that are not read, number 6"):
                gaussians_in(tmp_path / "a.spz")


def test_degree_4_of_spz_is_cut_to_3(tmp_path: Path) -> None:
    (tmp_path / "a.spz").write_bytes(packed(3, 1, 4, body(b"\0\0\0\0", bytes(range(72)))))
    assert gaussians_in(tmp_path / "a.spz").degree == 3


def test_damaged_spz_is_refused(tmp_path: Path) -> None:
    file, one = tmp_path / "a.spz", body(bytes(3))
    for version in (0, 4, 5, 2**31):
        assert f"SPZ of version {version};" in refused_in_a_line(file, packed(version, 1, 0, one))
    assert "SPZ of version 0;" in refused_in_a_line(file, b"NGSP" + bytes(100))
    assert "does not begin with NGSP" in refused_in_a_line(file, gzip.compress(bytes(100)))
    assert "of degree 5" in refused_in_a_line(file, packed(2, 1, 5, one))
    assert "31 fractional" in refused_in_a_line(file, packed(2, 1, 0, one, fraction=31))
    assert "4,294,967,295 Gaussians" in refused_in_a_line(file, packed(2, 2**32 - 1, 0, one))
    assert "truncated" in refused_in_a_line(file, packed(2, 10_000_000, 3, one))  # 640 MB are not asked for
    assert "truncated: 10,000,001 Gaussians" in refused_in_a_line(file, packed(2, 10_000_001, 0, one))
    assert "truncated" in refused_in_a_line(file, packed(2, 2, 0, one))
    assert "holds no Gaussians" in refused_in_a_line(file, packed(2, 0, 0, b""))
    assert "too much behind its 1 Gaussians" in refused_in_a_line(file, packed(2, 1, 0, one + bytes(20_000_000)))
    whole = packed(2, 1, 0, one)
    assert "is damaged" in refused_in_a_line(file, whole[:-8] + bytes(4) + whole[-4:])
    refused_in_a_line(file, whole + b"something else")


def test_truncated_spz_is_refused_wherever_it_ends(tmp_path: Path) -> None:
    whole = encoded(some(2000))
    assert len(whole) > 30_000
    for size in [*range(0, len(whole), 997), len(whole) - 9, len(whole) - 1]:
        assert "a.spz" in refused_in_a_line(tmp_path / "a.spz", whole[:size]), size


def test_spz_with_a_wrong_byte_is_refused(tmp_path: Path) -> None:
    whole = encoded(some(300, 1))
    for place in range(whole.index(0, COMMENT_START), len(whole), 97):
        damaged = bytearray(whole)
        damaged[place] ^= 16
        assert "a.spz" in refused_in_a_line(tmp_path / "a.spz", bytes(damaged)), place


# -- frames ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", range(4))
def test_transformed_gaussians_look_the_same_from_a_transformed_camera(degree: int) -> None:
    gaussians = some(30, degree).map(lambda values: values.double())
    rotation, scale, shift = turn(), 2.5, torch.tensor([1.0, -2.0, 3.0])
    moved = transformed(gaussians, rotation, scale, shift)
    torch.testing.assert_close(moved.means, scale * gaussians.means @ rotation.T + shift.double())
    expected = scale**2 * rotation @ covariances(gaussians) @ rotation.T
    torch.testing.assert_close(covariances(moved), expected, rtol=1e-10, atol=1e-12)
    assert torch.equal(moved.logits, gaussians.logits)
    assert torch.equal(moved.colors, gaussians.colors)
    for direction in directions():
        torch.testing.assert_close(seen(moved, rotation @ direction), seen(gaussians, direction), rtol=0, atol=1e-12)


def test_harmonics_rotate_as_a_group() -> None:
    harmonics, first, second = some(5).harmonics.double(), turn(3), turn(4)
    one_by_one = rotated_harmonics(rotated_harmonics(harmonics, first), second)
    torch.testing.assert_close(one_by_one, rotated_harmonics(harmonics, second @ first), atol=1e-12, rtol=0)
    torch.testing.assert_close(rotated_harmonics(harmonics, torch.eye(3).double()), harmonics, atol=1e-13, rtol=0)
    assert float(rotated_harmonics(harmonics, first).norm()) == pytest.approx(float(harmonics.norm()))


def test_harmonics_of_a_reflected_direction_are_harmonics_of_the_viewing_direction() -> None:
    """So a method that evaluates a Gaussian's own harmonics in the direction that it reflects gains no new colours."""
    normal = torch.nn.functional.normalize(
        torch.randn(3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)), dim=0
    )
    mirror = torch.eye(3).double() - 2 * torch.outer(normal, normal)
    harmonics, where = some(5).harmonics.double(), torch.stack(list(directions()))
    reflected = where - 2 * (where @ normal)[:, None] * normal
    expected = harmonics @ spherical_harmonics_reference(reflected, 4)[:, 1:].T
    found = rotated_harmonics(harmonics, mirror) @ spherical_harmonics_reference(where, 4)[:, 1:].T
    torch.testing.assert_close(found, expected, atol=1e-12, rtol=0)


def test_quaternions() -> None:
    half_turns = [torch.diag(torch.tensor(signs)).double() for signs in ((1, -1, -1), (-1, 1, -1), (-1, -1, 1))]
    for rotation in [torch.eye(3).double(), *half_turns, *(turn(seed) for seed in range(20))]:
        torch.testing.assert_close(matrices(quaternion(rotation)[None])[0], rotation, atol=1e-12, rtol=0)
    first, second = torch.randn(2, 10, 4).double()
    torch.testing.assert_close(matrices(quaternion_product(first, second)), matrices(first) @ matrices(second))


def test_float32_loses_no_more_than_rounding() -> None:
    gaussians, placement = some(100), Placement(torch.cat([turn(), torch.ones(3, 1)], -1), 0.25)
    back = transformed(gaussians, *placement.original_similarity())
    there = transformed(back, placement.transform[:, :3], 0.25, 0.25 * placement.transform[:, 3])
    for name in ("means", "log_scales", "harmonics"):
        torch.testing.assert_close(getattr(there, name), getattr(gaussians, name), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(
        back.means.double(), placement.original_points(gaussians.means.double()), atol=1e-5, rtol=0
    )


def test_what_is_no_similarity_is_refused() -> None:
    for rotation in (-torch.eye(3), 2 * torch.eye(3), torch.full((3, 3), math.nan)):
        with pytest.raises(ValueError, match="is not a rotation"):
            transformed(some(1), rotation, 1.0, torch.zeros(3))
    for scale in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(ValueError, match="must be positive"):
            transformed(some(1), torch.eye(3), scale, torch.zeros(3))


# -- size -----------------------------------------------------------------------------------------------------------


@pytest.mark.medium
@pytest.mark.parametrize("suffix", ["ply", "spz"])
def test_max_megabytes_holds_and_no_more_is_given_up_than_needed(tmp_path: Path, suffix: str) -> None:
    gaussians, file = some(4000), tmp_path / f"a.{suffix}"
    gaussians.colors.clamp_(-3, 3)  # the range of SPZ
    gaussians.harmonics.clamp_(-1, 1)
    assert write_gaussians(file, gaussians, 100.0) == []
    whole = file.stat().st_size
    assert write_gaussians(file, gaussians, whole / 1e6) == []  # it just fits
    counts, degrees = [], []
    for limit in np.linspace(whole - 1, whole / 200, 16).tolist():
        said = write_gaussians(file, gaussians, limit / 1e6)
        assert limit * 0.5 < file.stat().st_size <= limit
        read = gaussians_in(file)
        counts.append(len(read))
        degrees.append(read.degree)
        assert len(said) == 1
        assert said[0].startswith(f"{limit / 1e6:g} MB hold ")
        assert (len(read) < 4000) == ("most visible of 4,000" in said[0])
        assert (read.degree < 3) == (f"harmonics up to degree {read.degree} of 3" in said[0])
        if len(read) < 4000:
            assert read.degree == 0
            assert file.stat().st_size > 0.95 * limit  # no more are dropped than must be
    assert counts == sorted(counts, reverse=True)
    assert degrees == sorted(degrees, reverse=True)
    assert {0, 1, 2} <= set(degrees)
    assert counts[0] == 4000 > counts[-1] > 0


def test_the_most_visible_stay_in_their_order() -> None:
    gaussians = some(100, 0)
    areas = gaussians.log_scales.sort(-1).values[:, 1:].sum(-1).exp() * gaussians.logits.sigmoid()
    torch.testing.assert_close(visibility(gaussians), areas / areas.max())
    kept, said = fitted_ply(gaussians, ply_size(100, 0) - 50 * 68)
    assert torch.equal(kept.means, gaussians.means[areas.argsort(descending=True)[:50].sort().values])
    assert said == "the 50 most visible of 100 Gaussians"


def test_coarser_bits_are_taken_where_they_cost_less_than_a_degree() -> None:
    """Large harmonics of degree 3, so that three bits of them are better than none."""
    gaussians = some(3000)
    gaussians.harmonics[:, :, 8:] *= 4
    assert colour_error(gaussians, 3, (4, 3)) < colour_error(gaussians, 2, (5, 4))
    assert fitted_spz(gaussians, len(encoded(gaussians)) - 1)[2] == "4 and 3 bits of harmonics instead of 5 and 4"
    gaussians.harmonics[:, :, 8:] /= 100
    assert fitted_spz(gaussians, len(encoded(gaussians)) - 1)[2].startswith("harmonics up to degree 2 of 3")


def test_limits_that_hold_nothing_are_refused(tmp_path: Path) -> None:
    for suffix in ("ply", "spz"):
        with pytest.raises(ConfigError, match="no Gaussian fits into 20 bytes"):
            write_gaussians(tmp_path / f"a.{suffix}", some(5), 20e-6)
    with pytest.raises(ConfigError, match=r"written to \.ply, \.spz, \.sog or \.glb files"):
        write_gaussians(tmp_path / "a.obj", some(5))


# -- how they are drawn -----------------------------------------------------------------------------------------------

LOOKS = (OURS, Look(antialiased=True), Look(blur=0.1), Look(True, 0.125, "depth"), Look(sort="depth"))


@pytest.mark.parametrize("suffix", ["ply", "spz"])
@pytest.mark.parametrize("look", LOOKS)
def test_files_say_how_gaussians_are_drawn(tmp_path: Path, suffix: str, look: Look) -> None:
    file = tmp_path / f"a.{suffix}"
    write_gaussians(file, some(20), look=look)
    assert read_gaussians(file).look == look
    if suffix == "spz":  # the bit that other programs read
        assert gzip.decompress(file.read_bytes())[14] == (1 if look.antialiased else 0)
    else:
        assert f"comment SplatRenderMode: {'mip' if look.antialiased else 'default'}\n".encode() in file.read_bytes()
    write_gaussians(file, some(3000), 0.1, look)  # and where some are left out
    assert file.stat().st_size <= 1e5
    assert read_gaussians(file).look == look


@pytest.mark.parametrize("flags", [0, 1, 3])
def test_spz_of_other_programs_is_sorted_by_depth(tmp_path: Path, flags: int) -> None:
    (tmp_path / "a.spz").write_bytes(packed(2, 1, 0, body(bytes([255, 127, 128])), flags=flags))
    assert read_gaussians(tmp_path / "a.spz").look == Look(antialiased=bool(flags & 1), sort="depth")


# -- ns-export ------------------------------------------------------------------------------------------------------


class Splats:
    """A model that only has Gaussians."""

    scene = SimpleNamespace(warped=False, moving=False, camera_to_worlds=None)

    def __init__(self, gaussians: Gaussians, look: Look = OURS) -> None:
        self.found, self.drawn = gaussians, look

    def look(self) -> Look:
        return self.drawn

    def gaussians(self, time: float | None = None) -> Gaussians:
        return self.found


UTM = torch.tensor([512345.678, 5403210.987, 432.1], dtype=torch.float64)
"""A place on Earth in metres."""


def pretend(monkeypatch: pytest.MonkeyPatch, model: object, placement: Placement, method: str) -> None:
    loaded = SimpleNamespace(model=model, placement=placement, method=method, scale=Scale())
    monkeypatch.setattr("nerfloom.cli.run_flags.trained_run", lambda path, *_: path)
    monkeypatch.setattr("nerfloom.training.load.load", lambda *_, **__: loaded)


def exported(monkeypatch: pytest.MonkeyPatch, folder: Path, suffix: str, *flags: str) -> None:
    """Let ns-export write splat.ply or splat.spz to a folder."""
    words = ("ns-export", "gaussian-splat", str(folder / "run"), "--output-dir", str(folder), "--format", suffix)
    monkeypatch.setattr("sys.argv", [*words, *flags])
    main()


@pytest.mark.parametrize("suffix", ["ply", "spz"])
def test_ns_export(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], suffix: str
) -> None:
    placement = Placement(torch.cat([turn(), torch.tensor([[1.0], [2.0], [3.0]])], -1), 0.25)
    gaussians = some(40)
    gaussians.means[3] = math.nan
    pretend(monkeypatch, Splats(gaussians, Look(True)), placement, "gaussian-splatting")
    exported(monkeypatch, tmp_path, suffix)
    said = capsys.readouterr().err
    assert "1 of 40 Gaussians are not finite" in said
    assert f"splat.{suffix}" in said
    read, look = read_gaussians(tmp_path / f"splat.{suffix}")
    assert look == Look(True)
    kept = gaussians[gaussians.finite()]
    # Input's units are four times the scene's.
    atol = 1e-4 if suffix == "ply" else 1e-3
    expected = placement.original_points(kept.means.double()).float()
    torch.testing.assert_close(read.means, expected, atol=atol, rtol=1e-5)
    torch.testing.assert_close(read.log_scales.sum(-1), kept.log_scales.sum(-1) + 3 * math.log(4), atol=0.1, rtol=0)
    if suffix == "ply":
        for direction in directions(5):
            original = placement.original_directions(direction[None])[0]
            torch.testing.assert_close(seen(read, original), seen(kept, direction), atol=1e-5, rtol=0)
    size = (tmp_path / f"splat.{suffix}").stat().st_size
    exported(monkeypatch, tmp_path, suffix, "--max-megabytes", f"{size / 2e6:.6f}")
    assert (tmp_path / f"splat.{suffix}").stat().st_size <= size / 2 + 1
    assert " MB hold harmonics up to degree" in capsys.readouterr().err


@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e5, 5e6])
@pytest.mark.parametrize("suffix", ["ply", "spz"])
def test_ns_export_near_the_origin_writes_what_it_always_wrote(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, unit: float
) -> None:
    """The Gaussians are in the frame of the input, without a second file, in any unit that the format can hold."""
    if suffix == "spz" and unit > 1e5:
        return  # SPZ holds positions up to 8,388,607
    placement = Placement(torch.cat([turn(), unit * torch.tensor([[1.0], [2.0], [3.0]]).double()], -1), 0.25 / unit)
    pretend(monkeypatch, Splats(some(40)), placement, "gaussian-splatting")
    exported(monkeypatch, tmp_path, suffix)
    write_gaussians(tmp_path / f"plain.{suffix}", transformed(some(40), *placement.original_similarity()))
    assert (tmp_path / f"splat.{suffix}").read_bytes() == (tmp_path / f"plain.{suffix}").read_bytes()
    assert not offset_file(tmp_path / f"splat.{suffix}").exists()


@pytest.mark.parametrize("unit", [1.0, 100.0])
@pytest.mark.parametrize("suffix", ["ply", "spz"])
def test_ns_export_far_from_the_origin_writes_about_a_local_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], suffix: str, unit: float
) -> None:
    """And the file beside leads back to the input's frame and to the scene's."""
    gaussians = some(500)
    placement = Placement(torch.cat([turn(), -(turn() @ UTM)[:, None]], -1), 0.25 / unit)
    pretend(monkeypatch, Splats(gaussians), placement, "gaussian-splatting")
    exported(monkeypatch, tmp_path, suffix)
    file = tmp_path / f"splat.{suffix}"
    assert f"splat.{suffix}.offset.json" in " ".join(capsys.readouterr().err.split())
    read = read_gaussians(file).gaussians
    truth = (gaussians.means.double() / placement.scale) @ turn() + UTM
    step = 1e-5 * unit + (0.5 * 2.0 ** -fractional_bits(read) if suffix == "spz" else 0.0)
    torch.testing.assert_close(read.means.double() + read_offset(file), truth, atol=step, rtol=0)
    back = transformed(read, *placement.about(read_offset(file)).similarity())
    torch.testing.assert_close(back.means, gaussians.means, atol=placement.scale * step + 1e-5, rtol=0)
    # The same folder, and a run near the origin.
    pretend(monkeypatch, Splats(gaussians), Placement.of(None, 1.0), "gaussian-splatting")
    exported(monkeypatch, tmp_path, suffix)
    assert not offset_file(file).exists()


def test_centres_in_double_precision_stay_in_it_until_they_are_placed(tmp_path: Path) -> None:
    """Files of other programs, which hold the coordinates of a survey as double."""
    gaussians, names = some(40), property_names(15)
    write_ply(tmp_path / "a.ply", gaussians)
    values = read_columns(tmp_path / "a.ply", read_header(tmp_path / "a.ply").elements["vertex"], names)
    far = gaussians.means.double() + UTM
    write_columns(tmp_path / "b.ply", list(zip(names, [*far.numpy().T, *values[3:]], strict=True)))
    read = read_gaussians(tmp_path / "b.ply").gaussians
    assert torch.equal(read.means, far)
    placed = transformed(read, torch.eye(3), 1.0, -UTM)
    assert placed.means.dtype == torch.float32
    torch.testing.assert_close(placed.means, gaussians.means, atol=1e-6, rtol=0)


def test_what_cannot_be_exported_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused) -> None:
    given = ("gaussian-splat", tmp_path / "run", "--output-dir", tmp_path)
    placement = Placement.of(None, 1.0)
    pretend(monkeypatch, SimpleNamespace(scene=Splats.scene), placement, "instant-ngp")
    message = "ns-export gaussian-splat: instant-ngp has no Gaussians; ns-train gaussian-splatting makes them"
    assert message in refused(main, *given)
    pretend(monkeypatch, Splats(some(1).map(lambda values: values * math.nan)), placement, "gaussian-splatting")
    assert "no Gaussians left" in refused(main, *given)
    pretend(monkeypatch, Splats(some(5)), placement, "gaussian-splatting")
    for wrong in ("0", "-1", "nan"):
        assert "--max-megabytes must be positive" in refused(main, *given, "--max-megabytes", wrong, status=2)
    assert "no Gaussian fits" in refused(main, *given, "--max-megabytes", "1e-5")

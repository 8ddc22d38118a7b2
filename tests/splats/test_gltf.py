"""glTF files with KHR_gaussian_splatting, read by struct and json alone, and their up direction."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nerfloom.base.errors import ConfigError
from nerfloom.cameras.poses import Placement
from nerfloom.data.offsets import read_offset
from nerfloom.splats.files import write_gaussians
from nerfloom.splats.look import OURS, Look
from nerfloom.splats.transform import transformed
from tests.splats.test_files import UTM, Splats, directions, exported, matrices, pretend, published, seen, some, turn

NAME = "KHR_gaussian_splatting"
KINDS = {5126: "<f4", 5123: "<u2"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def read(file: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The JSON of a GLB file, and its attributes (N, C) by name; chunks and alignment are checked."""
    content = file.read_bytes()
    assert struct.unpack_from("<4sII", content) == (b"glTF", 2, len(content))
    length, kind = struct.unpack_from("<I4s", content, 12)
    assert (kind, length % 4) == (b"JSON", 0)
    described = json.loads(content[20 : 20 + length])
    size, kind = struct.unpack_from("<I4s", content, 20 + length)
    assert (kind, size % 4) == (b"BIN\0", 0)
    binary = content[28 + length :]
    assert len(binary) == size == described["buffers"][0]["byteLength"]
    attributes = {}
    for name, index in described["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = described["accessors"][index]
        view = described["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        width, kind = WIDTHS[accessor["type"]], np.dtype(KINDS[accessor["componentType"]])
        assert view["byteLength"] == accessor["count"] * width * kind.itemsize
        assert (width * kind.itemsize) % 4 == 0
        values = np.frombuffer(binary, kind, accessor["count"] * width, view["byteOffset"]).reshape(-1, width)
        attributes[name] = values / 65535 if accessor.get("normalized") else values
    return described, attributes


@pytest.mark.parametrize("degree", range(4))
def test_attributes_are_those_of_the_extension(tmp_path: Path, degree: int) -> None:
    """Nothing is rounded but to float32; sizes and opacities are after their activations."""
    given = some(40, degree)
    assert write_gaussians(tmp_path / "a.glb", given) == []
    described, found = read(tmp_path / "a.glb")
    assert described["extensionsUsed"] == [NAME]
    primitive = described["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0
    stated = primitive["extensions"][NAME]
    assert (stated["kernel"], stated["colorSpace"]) == ("ellipse", "srgb_rec709_display")
    assert (stated["projection"], stated["sortingMethod"]) == ("perspective", "cameraDistance")
    names = {"POSITION", "COLOR_0", f"{NAME}:ROTATION", f"{NAME}:SCALE", f"{NAME}:OPACITY"}
    coefficients = [(level, order) for level in range(degree + 1) for order in range(2 * level + 1)]
    assert set(found) == names | {f"{NAME}:SH_DEGREE_{level}_COEF_{order}" for level, order in coefficients}
    np.testing.assert_array_equal(found["POSITION"], given.means.numpy())
    ends = described["accessors"][primitive["attributes"]["POSITION"]]
    assert ends["min"] == given.means.amin(0).tolist()
    assert ends["max"] == given.means.amax(0).tolist()
    np.testing.assert_allclose(found[f"{NAME}:SCALE"], given.log_scales.double().exp().numpy(), rtol=1e-6)
    np.testing.assert_allclose(found[f"{NAME}:OPACITY"][:, 0], given.logits.double().sigmoid().numpy(), rtol=1e-6)
    x, y, z, w = found[f"{NAME}:ROTATION"].astype(np.float64).T
    np.testing.assert_allclose(x * x + y * y + z * z + w * w, 1, rtol=0, atol=1e-6)
    stored = torch.from_numpy(np.stack([w, x, y, z], -1))
    torch.testing.assert_close(matrices(stored), matrices(given.rotations), rtol=0, atol=1e-6)
    np.testing.assert_array_equal(found[f"{NAME}:SH_DEGREE_0_COEF_0"], given.colors.numpy())
    for direction in directions(5):
        light = np.zeros((40, 3))
        for (level, order), value in zip(coefficients[1:], published(direction).tolist(), strict=False):
            light += value * found[f"{NAME}:SH_DEGREE_{level}_COEF_{order}"].astype(np.float64)
        np.testing.assert_allclose(light, seen(given, direction).numpy(), rtol=0, atol=1e-6)


def test_points_of_other_programs_have_linear_colours(tmp_path: Path) -> None:
    """0.5 of sRGB is 0.2140 of the light, and 0.04 of it is on the linear piece."""
    given = some(3, 0)
    shades = torch.tensor([[0.5, 0.04, 1.0], [0.0, 2.0, -1.0], [0.5, 0.5, 0.5]])
    given.colors[:] = (shades - 0.5) / 0.28209479177387814
    given.logits[:] = torch.tensor([0.0, 100.0, -100.0])
    write_gaussians(tmp_path / "a.glb", given)
    expected = [[0.21404, 0.04 / 12.92, 1, 0.5], [0, 1, 0, 1], [0.21404, 0.21404, 0.21404, 0]]
    np.testing.assert_allclose(read(tmp_path / "a.glb")[1]["COLOR_0"], expected, rtol=0, atol=2e-5)


def test_what_the_extension_cannot_say_is_said(tmp_path: Path) -> None:
    file = tmp_path / "a.glb"
    assert write_gaussians(file, some(3), look=OURS) == []
    (said,) = write_gaussians(file, some(3), look=Look(True, 0.1, "depth"))
    assert said.startswith("glTF cannot say ")
    for word in ("antialiasing", "0.1 pixels^2", "depth"):
        assert word in said
    extras = read(file)[0]["meshes"][0]["primitives"][0]["extensions"][NAME]["extras"]
    assert extras["comments"] == ["SplatRenderMode: mip", "SplatBlur: 0.1", "SplatSort: depth"]


def test_huge_sizes_stay_finite(tmp_path: Path) -> None:
    given = some(2, 0)
    given.log_scales[:] = 1000.0
    write_gaussians(tmp_path / "a.glb", given)
    assert np.isfinite(read(tmp_path / "a.glb")[1][f"{NAME}:SCALE"]).all()


def test_max_megabytes_holds(tmp_path: Path) -> None:
    given, file = some(500), tmp_path / "a.glb"
    write_gaussians(file, given)
    whole = file.stat().st_size
    for share, words in ((0.9, "harmonics up to degree 2 of 3"), (0.1, "most visible of 500 Gaussians")):
        assert words in write_gaussians(file, given, share * whole / 1e6)[0]
        assert file.stat().st_size <= share * whole
    with pytest.raises(ConfigError, match="no Gaussian fits into 20 bytes"):
        write_gaussians(file, given, 20e-6)
    with pytest.raises(ConfigError, match="at least one Gaussian"):
        write_gaussians(file, given[:0])


# -- up -------------------------------------------------------------------------------------------------------------

UP = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)


def test_up_is_y() -> None:
    plain = Placement(torch.eye(4, dtype=torch.float64)[:3], 0.5)
    point = torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64)
    torch.testing.assert_close(plain.y_up().original_points(0.5 * point), torch.tensor([[1.0, 3.0, -2.0]]).double())
    for seed in range(5):
        shift = torch.tensor([[5.0], [-3.0], [2.0]], dtype=torch.float64)
        placement = Placement(torch.cat([turn(seed), shift], -1), 0.25)
        turned = placement.y_up()
        torch.testing.assert_close(turned.original_directions(UP), torch.tensor([[0.0, 1.0, 0.0]]).double())
        rotation = turned.original_similarity()[0] @ placement.similarity()[0]  # from the input's axes
        torch.testing.assert_close(rotation @ rotation.T, torch.eye(3).double())
        assert float(torch.linalg.det(rotation)) == pytest.approx(1)
        points = placement.original_points(torch.randn(10, 3).double())
        scene = placement.points(points)
        torch.testing.assert_close(turned.original_points(scene), points @ rotation.T)  # about the same origin


def test_ns_export_turns_up_to_y(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Positions, and light from a direction, follow the scene's up direction."""
    placement = Placement(torch.cat([turn(), torch.tensor([[1.0], [2.0], [3.0]])], -1), 0.25)
    given = some(40)
    pretend(monkeypatch, Splats(given, Look()), placement, "gaussian-splatting")
    exported(monkeypatch, tmp_path, "glb")
    found = read(tmp_path / "splat.glb")[1]
    expected = transformed(given, *placement.y_up().original_similarity())
    np.testing.assert_allclose(found["POSITION"], expected.means.numpy(), rtol=1e-5, atol=1e-5)
    heights = placement.scale * found["POSITION"][:, 1].astype(np.float64)
    above = heights - heights.mean()
    np.testing.assert_allclose(above, (given.means[:, 2] - given.means[:, 2].mean()).numpy(), rtol=0, atol=1e-5)
    light = light_from(found, torch.tensor([0.0, 1.0, 0.0]).double())
    np.testing.assert_allclose(light, seen(given, UP[0]).numpy(), rtol=0, atol=1e-5)


def light_from(found: dict[str, np.ndarray], direction: torch.Tensor) -> np.ndarray:
    names = [f"{NAME}:SH_DEGREE_{level}_COEF_{order}" for level in (1, 2, 3) for order in range(2 * level + 1)]
    values = zip(published(direction).tolist(), names, strict=True)
    return np.sum([value * found[name].astype(np.float64) for value, name in values], axis=0)


def test_ns_export_far_from_the_origin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The offset leads to the frame of the input, turned."""
    given = some(500)
    placement = Placement(torch.cat([turn(), -(turn() @ UTM)[:, None]], -1), 0.25)
    pretend(monkeypatch, Splats(given), placement, "gaussian-splatting")
    exported(monkeypatch, tmp_path, "glb")
    there = torch.from_numpy(read(tmp_path / "splat.glb")[1]["POSITION"].astype(np.float64))
    there += read_offset(tmp_path / "splat.glb")
    truth = placement.y_up().original_points(given.means.double())
    assert float((there - truth).abs().max()) < 1e-4
    assert float(there.norm(dim=-1).min()) > 1e6


def test_ns_export_writes_every_version_of_spz(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    placement = Placement(torch.eye(4, dtype=torch.float64)[:3], 1.0)
    pretend(monkeypatch, Splats(some(20)), placement, "gaussian-splatting")
    pytest.importorskip("zstandard")
    starts = []
    for version in ("2", "3", "4"):
        exported(monkeypatch, tmp_path, "spz", "--spz-version", version)
        starts.append((tmp_path / "splat.spz").read_bytes()[:4])
    assert starts[2] == b"NGSP"
    assert {start[:2] for start in starts[:2]} == {b"\x1f\x8b"}


def test_gaussians_are_not_changed_by_writing(tmp_path: Path) -> None:
    given = some(30)
    before = given.map(torch.clone)
    for name in ("a.ply", "a.spz", "a.sog", "a.glb"):
        write_gaussians(tmp_path / name, given)
    assert all(torch.equal(before.columns[name], values) for name, values in given.columns.items())

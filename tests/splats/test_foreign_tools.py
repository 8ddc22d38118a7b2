"""Files against other programs: they read what we write, and we read what they write.

`NERFLOOM_NODE_TOOLS` names the folder where npm has installed `PACKAGES`; Node 20 runs them. `pytest -s` shows the
largest differences, and docs/notes/splatting.md has them.
"""

import csv
import json
import math
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from nerfloom.cameras.poses import Placement
from nerfloom.cameras.scale import Scale
from nerfloom.data.offsets import read_offset
from nerfloom.export.mesh import Mesh
from nerfloom.export.mesh_files import write_mesh
from nerfloom.export.texture import Texture
from nerfloom.splats.files import read_gaussians, write_gaussians
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import OURS, Look
from nerfloom.splats.placed_files import write_placed
from nerfloom.splats.spz import fractional_bits
from nerfloom.splats.spz_container import SpzVersion
from nerfloom.splats.transform import transformed
from tests.splats.test_files import UTM, matrices, some
from tests.splats.test_sog import logs, matched

PACKAGES = (
    "@playcanvas/splat-transform",
    "@adobe/spz",
    "spz-js",
    "gsplat",
    "@mkkellogg/gaussian-splats-3d",
    "playcanvas",
    "three",
    "gltf-validator",
)
Differences = dict[str, float]
FLOAT = 1e-5
"""Rounding of float32, at positions up to 20."""
pytestmark = pytest.mark.slow


def called(words: list[str], script: str = "") -> None:
    done = subprocess.run(words, input=script, cwd=tools(), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]


def tools() -> Path:
    """The folder of the tools; without them a test is skipped."""
    folder = os.environ.get("NERFLOOM_NODE_TOOLS")
    if folder is None or shutil.which("node") is None:
        pytest.skip("NERFLOOM_NODE_TOOLS names no folder of tools, or there is no node")
    if missing := [name for name in PACKAGES if not (Path(folder) / "node_modules" / name).is_dir()]:
        pytest.skip(f"not in {folder}/node_modules: {', '.join(missing)}")
    return Path(folder)


def run(*words: str | Path) -> None:
    """Run commands of foreign_tools.mjs: name, input and output of each."""
    script = Path(__file__).with_name("foreign_tools.mjs").read_text()
    called(["node", "--input-type=module", "-", *map(str, words)], script)


def convert(source: Path, target: Path) -> Path:
    """Convert a file by splat-transform, and return the path of the result."""
    target.parent.mkdir(exist_ok=True)
    version = ["--spz-version", "3"] if target.name.endswith("3.spz") else []
    flags = ["--quiet", "--overwrite", "--gpu", "cpu", "--iterations", "1", *version]
    called(["node", f"node_modules/{PACKAGES[0]}/bin/cli.mjs", *flags, str(source), str(target)])
    return target


def scene(degree: int = 3, seed: int = 0) -> Gaussians:
    """2,000 Gaussians with colours in the range of SPZ."""
    given = some(2000, degree, seed)
    return replace(given, colors=given.colors.clamp(-3.3, 3.3))


def in_cloud(file: Path) -> tuple[Gaussians, bool]:
    """The Gaussians in a cloud of foreign_tools.mjs, and whether they are antialiased."""
    cloud = json.loads(file.read_text())
    names = ("positions", "scales", "rotations", "alphas", "colors", "sh")
    parts = {name: torch.tensor(cloud[name], dtype=torch.float32) for name in names}
    count = len(parts["alphas"])
    gaussians = Gaussians(
        means=parts["positions"].view(count, 3),
        log_scales=parts["scales"].view(count, 3),
        rotations=parts["rotations"].view(count, 4).roll(1, 1),
        logits=parts["alphas"].clamp(-16, 16),
        colors=parts["colors"].view(count, 3),
        harmonics=parts["sh"].view(count, -1, 3).mT if len(parts["sh"]) else torch.zeros(count, 3, 0),
    )
    return gaussians, bool(cloud.get("antialiased"))


def cloud_of(file: Path, given: Gaussians, antialiased: bool = False, version: int = 4) -> Path:
    unit = given.rotations / given.rotations.norm(dim=-1, keepdim=True)
    arrays = {
        "positions": given.means,
        "scales": given.log_scales,
        "rotations": unit.roll(-1, 1),
        "alphas": given.logits,
        "colors": given.colors,
        "sh": given.harmonics.mT,
    }
    numbers = {"numPoints": len(given), "shDegree": given.degree, "antialiased": antialiased, "version": version}
    file.write_text(json.dumps({**numbers, **{name: values.flatten().tolist() for name, values in arrays.items()}}))
    return file


def in_table(file: Path) -> Gaussians:
    """The Gaussians in a CSV file of splat-transform, with the names of a PLY file."""
    with file.open() as stream:
        names, *rows = csv.reader(stream)
    table = dict(zip(names, torch.tensor([[float(value) for value in row] for row in rows]).T, strict=True))

    def columns(*names: str) -> torch.Tensor:
        return torch.stack([table[name] for name in names], -1) if names else torch.zeros(len(rows), 0)

    rest = columns(*[f"f_rest_{index}" for index in range(sum(name.startswith("f_rest_") for name in names))])
    return Gaussians(
        means=columns("x", "y", "z"),
        log_scales=columns("scale_0", "scale_1", "scale_2"),
        rotations=columns("rot_0", "rot_1", "rot_2", "rot_3"),
        logits=table["opacity"].clamp(-16, 16),
        colors=columns("f_dc_0", "f_dc_1", "f_dc_2"),
        harmonics=rest.view(len(rows), 3, -1),
    )


def differences(read: Gaussians, given: Gaussians, permuted: bool = False) -> Differences:
    """The largest differences between Gaussians in the same order; `permuted`: the axes of each may be permuted."""
    turns = matrices(given.rotations).mT @ matrices(read.rotations)
    axes = turns.round()
    assert bool((axes.abs().sum(1) == 1).all())
    assert permuted or bool((axes == torch.eye(3)).all())
    cosines = ((axes.mT @ turns).diagonal(dim1=1, dim2=2).sum(1) - 1) / 2
    log_scales = (axes.abs().mT @ given.log_scales.double()[:, :, None])[..., 0]
    assert read.degree == given.degree
    harmonics = (read.harmonics - given.harmonics).abs()
    return {
        "positions": float((read.means - given.means).abs().max()),
        "log scales": float((read.log_scales - log_scales).abs().max()),
        "rotations": float(cosines.clamp(-1, 1).acos().rad2deg().max()),
        "opacities": float((read.logits.sigmoid() - given.logits.sigmoid()).abs().max()),
        "colours": float((read.colors - given.colors).abs().max()),
        **({"degree 1": float(harmonics[..., :3].max())} if read.degree else {}),
        **({"degrees 2, 3": float(harmonics[..., 3:].max())} if read.degree > 1 else {}),
    }


def told(what: str, found: Differences, bounds: Differences | None = None) -> None:
    """Print a row of the table; check it."""
    print(f"{what:34}", *(f"{name} {value:.2g};" for name, value in found.items()))
    for name, value in found.items():
        assert bounds is None or value <= bounds[name], (what, name, value)


NOTHING = dict.fromkeys(("positions", "log scales", "colours", "degree 1", "degrees 2, 3"), FLOAT) | {
    "rotations": 1e-3,
    "opacities": 1.01e-3,  # opacities of 0 and 1 have infinite logits in other programs
}
"""Bounds where nothing is rounded but to float32."""


def spz_bounds(given: Gaussians, version: int) -> Differences:
    """Half a step (`nerfloom.splats.spz`). Niantic's library rounds harmonics to 8 bits first: half a step more."""
    return {
        "positions": 0.5 * 2.0 ** -fractional_bits(given) + FLOAT,
        "log scales": 1 / 32 + FLOAT,
        "rotations": 0.92 if version == 2 else 0.28,
        "opacities": 0.5 / 255 + FLOAT,
        "colours": 0.5 / 255 / 0.15 + FLOAT,
        "degree 1": 1 / 32 + 1 / 256 + FLOAT,
        "degrees 2, 3": 1 / 16 + 1 / 256 + FLOAT,
    }


# -- they read ours ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", range(4))
def test_others_read_our_files(tmp_path: Path, degree: int) -> None:
    given, exact = scene(degree), {**NOTHING, "opacities": FLOAT}
    look = Look(antialiased=degree % 2 == 0)
    ours = {name: tmp_path / name for name in ("a.ply", "a.sog", "a.glb", "a2.spz", "a3.spz", "a4.spz")}
    for name, file in ours.items():
        version: SpzVersion = {"a3.spz": 3, "a4.spz": 4}.get(name, 2)  # type: ignore[assignment]
        write_gaussians(file, given, look=look, spz_version=version)
    spz = [("read-spz", ours[f"a{version}.spz"], tmp_path / f"{version}.json") for version in (2, 3, 4)]
    js, glb = tmp_path / "js.json", tmp_path / "glb.json"
    run(
        *[word for words in spz for word in words],
        "read-spz-js",
        ours["a2.spz"],
        js,
        "read-splat-glb",
        ours["a.glb"],
        glb,
    )
    told("PLY: splat-transform", differences(in_table(convert(ours["a.ply"], tmp_path / "a.csv")), given), exact)
    told("glTF: PlayCanvas's engine", differences(in_cloud(glb)[0], given), exact)
    for version in (2, 3, 4):
        read, antialiased = in_cloud(tmp_path / f"{version}.json")
        assert antialiased == look.antialiased
        told(f"SPZ {version}: spz", differences(read, given, version == 2), spz_bounds(given, version))
    read, antialiased = in_cloud(js)
    assert antialiased == look.antialiased
    told("SPZ 2: spz-js", differences(other_axes(read), given, True), spz_bounds(given, 2))
    read = in_table(convert(ours["a.sog"], tmp_path / "sog.csv"))
    told("SOG: splat-transform", differences(read, matched(read, given)), sog_bounds(given))


def other_axes(gaussians: Gaussians) -> Gaussians:
    """Between SPZ's axes and PLY's: spz-js does not change them."""
    return transformed(gaussians, torch.diag(torch.tensor([1.0, -1.0, -1.0])), 1.0, torch.zeros(3))


def sog_bounds(given: Gaussians) -> Differences:
    """As `encoded_sog` states them; harmonics are as far from each other as from their palette."""
    low, high = logs(given.means).amin(0), logs(given.means).amax(0)
    furthest = float(torch.maximum(low.abs(), high.abs()).max())
    return {
        "positions": math.exp(furthest) * float((high - low).max()) / 131070 + FLOAT,
        "log scales": float(given.log_scales.max() - given.log_scales.min()) / 255,
        "rotations": 1.2,
        "opacities": 0.5 / 255 + FLOAT,
        "colours": float(given.colors.max() - given.colors.min()) / 255,
        "degree 1": 1.0,
        "degrees 2, 3": 1.0,
    }


def test_others_read_files_far_from_the_origin(tmp_path: Path) -> None:
    """The positions in a file, and its offset, give the original positions."""
    given = scene(1)
    moved = replace(given, means=given.means.double() + UTM)
    placement = Placement(torch.eye(4, dtype=torch.float64)[:3], 1.0)
    for name in ("a.ply", "a.glb", "a.spz", "a.sog"):
        write_placed(tmp_path / name, moved, OURS, Scale(), placement)
    run(
        "read-splat-glb",
        tmp_path / "a.glb",
        tmp_path / "glb.json",
        "read-spz",
        tmp_path / "a.spz",
        tmp_path / "spz.json",
    )
    y_up = placement.to_y_up()
    for name, read, bounds in (
        ("a.ply", in_table(convert(tmp_path / "a.ply", tmp_path / "ply.csv")), NOTHING),
        ("a.glb", in_cloud(tmp_path / "glb.json")[0], NOTHING),
        ("a.spz", in_cloud(tmp_path / "spz.json")[0], spz_bounds(given, 2)),
        ("a.sog", in_table(convert(tmp_path / "a.sog", tmp_path / "sog.csv")), sog_bounds(given)),
    ):
        means = read.means.double() + read_offset(tmp_path / name)
        means = (means @ y_up if name == "a.glb" else means) - UTM
        if name == "a.sog":
            means = means[torch.cdist(given.means.double(), means).argmin(1)]
        off = float((means - given.means).abs().max())
        print(f"{name} far away: positions {off:.2g}")
        assert off <= bounds["positions"]


def test_glb_files_are_valid_gltf(tmp_path: Path) -> None:
    """gltf-validator does not know the extension of splats, and refuses the names of its attributes alone."""
    solid = mesh()
    meshes = {
        "plain": Mesh(solid.vertices, solid.faces),
        "colours": replace(solid, texture=None),
        "texture": solid,
        "far": replace(solid, vertices=solid.vertices + UTM),
    }
    for name, given in meshes.items():
        write_mesh(tmp_path / f"{name}.glb", given)
    write_gaussians(tmp_path / "splats.glb", scene())
    names = ["splats", *meshes]
    run(*[word for name in names for word in ("validate", tmp_path / f"{name}.glb", tmp_path / f"{name}.json")])
    for name in names:
        messages = json.loads((tmp_path / f"{name}.json").read_text())
        if name == "splats":
            messages = [each for each in messages if "KHR_gaussian_splatting" not in each["pointer"] + each["message"]]
        assert messages == [], name


def mesh() -> Mesh:
    """A tetrahedron with normals, colours and a texture."""
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=torch.float64)
    faces = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    normals = torch.nn.functional.normalize(vertices - vertices.mean(0), dim=-1)
    texture = Texture(torch.randint(0, 256, (8, 8, 3), dtype=torch.uint8), torch.rand(4, 3, 2))
    return Mesh(vertices, faces, normals, torch.rand(4, 3), texture)


def test_three_reads_our_meshes(tmp_path: Path) -> None:
    """three.js takes colours of vertices for linear light, and does not light them."""
    solid = mesh()
    assert solid.normals is not None
    assert solid.colors is not None
    assert solid.texture is not None
    write_mesh(tmp_path / "a.glb", replace(solid, texture=None))
    write_mesh(tmp_path / "b.glb", solid)
    run("read-mesh", tmp_path / "a.glb", tmp_path / "a.json", "read-mesh", tmp_path / "b.glb", tmp_path / "b.json")
    (coloured,), (textured,) = (json.loads((tmp_path / f"{name}.json").read_text()) for name in "ab")
    assert coloured["material"] == textured["material"] == "MeshBasicMaterial"
    assert list(coloured["index"]) == solid.faces.flatten().tolist()
    corners = solid.faces.flatten()
    for read, rows in ((coloured, torch.arange(4)), (textured, corners)):
        off = float((torch.tensor(read["position"]).view(-1, 3) - solid.vertices[rows]).abs().max())
        turned = float((torch.tensor(read["normal"]).view(-1, 3) - solid.normals[rows]).abs().max())
        print(f"mesh, three.js: positions {off:.2g}; normals {turned:.2g}")
        assert max(off, turned) <= 1e-6
    light = torch.tensor(coloured["color"]).view(4, -1)[:, :3]
    shown = torch.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    print(f"mesh, three.js: colours {float((shown - solid.colors).abs().max()):.2g}")
    torch.testing.assert_close(shown, solid.colors, rtol=0, atol=1e-6)
    places = torch.tensor(textured["uv"]).view(-1, 2)
    torch.testing.assert_close(1 - places[:, 1], solid.texture.coordinates.reshape(-1, 2)[:, 1], rtol=0, atol=1e-6)


# -- we read theirs ---------------------------------------------------------------------------------------------------


def both_read(file: Path, what: str, rotations: float = NOTHING["rotations"]) -> Gaussians:
    """What we read, which splat-transform also reads, but for `rotations` degrees."""
    read, theirs = read_gaussians(file).gaussians, in_table(convert(file, file.with_suffix(".csv")))
    told(f"{what}: both", differences(read, theirs), {**NOTHING, "rotations": rotations})
    return read


def test_we_read_what_splat_transform_writes(tmp_path: Path) -> None:
    given = scene()
    write_gaussians(tmp_path / "a.ply", given)

    def written(name: str) -> Path:
        return convert(tmp_path / "a.ply", tmp_path / name)

    told("PLY of splat-transform", differences(both_read(written("b.ply"), "PLY"), given), NOTHING)
    for version in (3, 4):
        read = both_read(written(f"b{version}.spz"), f"SPZ {version}")
        told(f"SPZ {version} of splat-transform", differences(read, given), spz_bounds(given, version))
    read = both_read(written("b.compressed.ply"), "compressed PLY")
    expected = matched(read, given)
    told("compressed PLY of splat-transform", differences(read, expected), compressed_bounds(expected))
    for name in ("b.sog", "folder/meta.json"):
        read = both_read(written(name), name)
        seen = read.logits.sigmoid() > 1 / 255  # in their images, Gaussians of opacity 0 have no colour
        told(f"{name} of splat-transform", differences(read[seen], matched(read, given)[seen]), their_sog_bounds(given))


def their_sog_bounds(given: Gaussians) -> Differences:
    """A whole step: it rounds down. Codes are not evenly spaced, so sizes and colours may be farther from one."""
    ours = sog_bounds(given)
    positions = {"positions": 2 * ours["positions"]}
    return ours | positions | {"log scales": 0.5, "colours": 0.5, "rotations": 1.6, "opacities": 1 / 255 + FLOAT}


def compressed_bounds(given: Gaussians) -> Differences:
    """Half a step of 10 bits between the ends of the widest chunk."""

    def widest(values: torch.Tensor) -> float:
        return max(float((part.amax(0) - part.amin(0)).max()) for part in values.split(256))

    return {
        "positions": 0.51 * widest(given.means) / 1023,
        "log scales": 0.51 * widest(given.log_scales) / 1023,
        "rotations": 0.28,
        "opacities": 0.5 / 255 + FLOAT,
        "colours": 0.51 * widest(given.colors) / 255,
        "degree 1": 1 / 64 + FLOAT,
        "degrees 2, 3": 1 / 64 + FLOAT,
    }


@pytest.mark.parametrize("degree", range(4))
def test_we_read_what_spz_writes(tmp_path: Path, degree: int) -> None:
    given, antialiased, words = scene(degree), degree % 2 == 0, list[str | Path]()
    for version in (3, 4):
        cloud = cloud_of(tmp_path / f"{version}.json", given, antialiased, version)
        words += ["write-spz", cloud, tmp_path / f"{version}.spz"]
    run(*words)
    for version in (3, 4):
        read, look = read_gaussians(tmp_path / f"{version}.spz")
        assert look.antialiased == antialiased
        told(f"SPZ {version} of spz", differences(read, given), spz_bounds(given, version))


def test_we_read_what_spz_js_writes(tmp_path: Path) -> None:
    """Where w of a quaternion is near 0, 8 bits of x, y and z do not say it well."""
    given, file = scene(), tmp_path / "a.spz"
    run("write-spz-js", cloud_of(tmp_path / "a.json", other_axes(given), True), file)
    assert read_gaussians(file).look.antialiased
    found = differences(both_read(file, "SPZ 2"), given, permuted=True)
    told("SPZ 2 of spz-js", found, {**spz_bounds(given, 2), "rotations": 12.0})


def test_we_read_splat_and_ksplat(tmp_path: Path) -> None:
    """Bytes of KSPLAT are rounded down. In rotations of .splat files 128 is 0; splat-transform takes 127.5."""
    given = scene(2)
    given = replace(given, colors=given.colors.clamp(-1.77, 1.77))
    write_gaussians(tmp_path / "a.ply", given)
    splat, *files = (tmp_path / name for name in ("a.splat", "a0.ksplat", "a1.ksplat", "a2.ksplat"))
    words = [word for file in files for word in ("write-ksplat", tmp_path / "a.ply", file)]
    run(*words, "write-splat", tmp_path / "a.ply", splat)
    bytes_ = {**NOTHING, "opacities": 1 / 255 + FLOAT, "colours": 1 / 255 / 0.28209 + FLOAT}
    halves = bytes_ | {"positions": 5 / 4 / 32767 + FLOAT, "log scales": 2**-10 + FLOAT, "rotations": 0.06}
    halves |= {"degree 1": 2**-11 + FLOAT, "degrees 2, 3": 2**-11 + FLOAT}
    step = float(given.harmonics.max() - given.harmonics.min()) / 255 + FLOAT
    coarse = halves | {"degree 1": step, "degrees 2, 3": step}
    for level, (file, bounds) in enumerate(zip(files, (bytes_, halves, coarse), strict=True)):
        read = both_read(file, f"KSPLAT {level}")
        told(f"KSPLAT {level} of GaussianSplats3D", differences(read, matched(read, given)), bounds)
    read = both_read(splat, ".splat", rotations=1.0)
    given = replace(given, harmonics=given.harmonics[..., :0])
    told(".splat of gsplat", differences(read, matched(read, given)), {**bytes_, "rotations": 1.2})

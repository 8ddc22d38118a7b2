"""The page of an octree: its data, its size, and the command."""

import gzip
import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from nerfloom.base.errors import ConfigError
from nerfloom.cameras.view import View
from nerfloom.evaluation.metrics import psnr
from nerfloom.export.octree_page import make_octree_page, octree_payload
from nerfloom.export.octree_size import chosen, is_too_fine
from nerfloom.export.run_page import export_page
from nerfloom.export.settings import WebSettings
from nerfloom.export.web import PICTURE, SCRIPTS, page, payload_of
from nerfloom.kernels.octree.light import error_bound, raw_of
from nerfloom.methods.voxels import Voxels
from nerfloom.octrees.coarser import halved
from nerfloom.octrees.drawn import DrawnOctree
from nerfloom.octrees.files import write_octree
from nerfloom.octrees.octree import Octree
from nerfloom.registry import load_method
from nerfloom.training.loaded import Loaded
from tests.cli.helpers import called
from tests.octrees.balls import ball, grains
from tests.patience import PATIENCE
from tests.training.helpers import TINY, tiny_trainer
from tests.web.helpers import ASLANT, octree_facts, some_cameras
from tests.web.test_scripts import PAGE

UPRIGHT = torch.eye(3, dtype=torch.float64)


def read(payload: bytes) -> dict[str, Any]:
    """The data of a page, by the description in `octree_page.py`."""
    raw, at, found = gzip.decompress(payload), 0, {}

    def take(kind: str, *shape: int) -> np.ndarray:
        nonlocal at
        values = np.frombuffer(raw, kind, int(np.prod(shape)), at)
        at += values.nbytes
        return values.reshape(shape)

    assert take("S4", 1)[0] == b"OCT1"
    degree, x, y, z, bricks, leaves = take("<u4", 6).tolist()
    terms = (degree + 1) ** 2
    found["origin"], (found["cell"], found["limit"]), found["turn"] = take("<f4", 3), take("<f4", 2), take("<f4", 3, 3)
    found["table"], found["scales"], found["offsets"] = take("<f4", 256), take("<f4", 3 * terms), take("<f4", 3 * terms)
    found["masks"], found["distances"] = take("<u8", bricks, 8), take("u1", x, y, z)
    found["codes"], found["colors"] = take("u1", leaves), take("u1", 3 * terms, leaves).T
    assert at == len(raw)
    return found


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_data_are_the_octree(degree: int) -> None:
    octree = grains(degree)
    found = read(octree_payload(octree, ASLANT))
    layout, leaves = octree.layout, octree.leaves
    np.testing.assert_array_equal(found["origin"], layout.origin.numpy())
    np.testing.assert_allclose(found["turn"], ASLANT.numpy(), atol=1e-7)
    np.testing.assert_array_equal(found["masks"].view(np.int64), layout.masks.numpy())
    np.testing.assert_array_equal(
        np.where(found["distances"], -1.0 * found["distances"], 0), layout.bricks.clamp(max=0)
    )
    for name in ("table", "scales", "offsets", "codes", "colors"):
        np.testing.assert_array_equal(found[name], getattr(leaves, name).numpy())
    assert found["cell"] == np.float32(layout.cell)
    # The end of a ray costs at most a step of eight bits.
    assert found["limit"] * error_bound(leaves.coefficients(), 1.0) == pytest.approx(1 / 255)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_textures_are_the_octree(degree: int) -> None:
    """The page's program unpacks the data; each leaf is looked up as the shader does it, by its cell."""
    if (node := shutil.which("node")) is None:
        pytest.skip("there is no Node.js; the page's program is not run")
    octree = grains(degree)
    raw = gzip.decompress(octree_payload(octree, ASLANT))
    scripts = [(PAGE / name).read_text(encoding="utf-8") for name in ("unpack.js", "webgl.js", "octree.js")]
    code = (
        f"const raw = Uint8Array.from({json.dumps(list(raw))});"
        "const found = octreeOf(raw), plain = Object.fromEntries(Object.entries(found).map("
        "([name, value]) => [name, ArrayBuffer.isView(value) ? [...value] : value]));"
        "console.log(JSON.stringify(plain));"
    )
    program = "".join(scripts) + code
    done = subprocess.run([node, "-"], input=program, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    layout, leaves, terms = octree.layout, octree.leaves, (degree + 1) ** 2
    x, y, z = layout.size
    assert found["extent"] == [x, y, z]
    assert found["count"] == layout.num_leaves
    bricks = np.array(found["bricks"])
    assert len(bricks) % 2048 == 0
    np.testing.assert_array_equal(bricks[: x * y * z].reshape(x, y, z), layout.bricks.numpy())
    np.testing.assert_allclose(found["depths"], leaves.table.numpy())
    np.testing.assert_allclose(np.array(found["scales"]).reshape(-1, 3).T.ravel(), leaves.scales.numpy())
    np.testing.assert_allclose(np.array(found["offsets"]).reshape(-1, 3).T.ravel(), leaves.offsets.numpy())

    cells = layout.cells().numpy()
    place, part, within = cells // 8, cells % 8 // 4, cells % 4
    brick = bricks[(place[:, 0] * y + place[:, 1]) * z + place[:, 2]]
    octants = np.array(found["octants"], np.uint64).reshape(-1, 4)[8 * brick + part @ [1, 2, 4]]
    bits = within @ [1, 4, 16]
    masks = octants[:, 0] | octants[:, 1] << np.uint64(32)
    below = [bin(int(mask) & ((1 << int(bit)) - 1)).count("1") for mask, bit in zip(masks, bits, strict=True)]
    assert all(int(mask) >> int(bit) & 1 for mask, bit in zip(masks, bits, strict=True))
    np.testing.assert_array_equal(octants[:, 2].astype(int) + below, np.arange(len(cells)))

    size = {0: 4, 1: 16, 2: 32, 3: 64}[degree]
    words = np.array(found["leaves"], np.uint64).astype("<u4")
    rows = words.view(np.uint8).reshape(-1, size)[: len(cells)]
    np.testing.assert_array_equal(rows[:, 0], leaves.codes.numpy())
    mixed = rows[:, 1 : 1 + 3 * terms].reshape(-1, terms, 3).transpose(0, 2, 1).reshape(len(cells), -1)
    np.testing.assert_array_equal(mixed, leaves.colors.numpy())


def test_a_page_of_an_octree_is_alone() -> None:
    """It has its own drawing part, the same other parts, and asks no host."""
    text = page(b"123", octree_facts(UPRIGHT))
    assert "function octreeOf(" in text
    assert "function gaussiansOf(" not in text
    assert set(SCRIPTS["octree"]) ^ set(SCRIPTS["gaussians"]) == {"octree.js", "splats.js"}
    for word in ("http:", "https:", "//cdn", "eval(", "new Function", "innerHTML", "SharedArrayBuffer", "import("):
        assert word not in text, word


# -- its size -----------------------------------------------------------------------------------------------------


def test_the_degree_and_the_leaves_that_fit() -> None:
    """A leaf of degree d has 1 + 3 (d + 1)^2 bytes, and 0.6 of them after compression."""
    largest = torch.cat([torch.linspace(0.1, 1, 1000), torch.zeros(500)])

    def found(size: float) -> tuple[int, int]:
        degree, kept = chosen(largest, size, (2, 1, 0))
        assert torch.equal(kept, torch.arange(1000 - len(kept), 1000))  # the most visible ones, in order
        return degree, len(kept)

    assert found(24_000) == (2, 1000)
    assert found(0.9 * 16_810) == (2, int(0.9 * 16_810 / 16.8))
    assert found(14_000) == (1, 1000)
    assert found(5_600) == (1, int(5_600 / 7.8))
    assert found(5_000) == (0, 1000)
    assert found(1_000) == (0, int(1_000 / 2.4))
    assert is_too_fine(largest, 1_100, (2, 1, 0))
    assert not is_too_fine(largest, 1_300, (2, 1, 0))
    assert is_too_fine(largest, 1_300, (2,))
    for weights, size in ((torch.zeros(5), 1e6), (largest, 1.0)):
        with pytest.raises(ConfigError):
            chosen(weights, size, (2, 1, 0))


@pytest.mark.medium
def test_larger_cells_hold_as_much_and_look_alike() -> None:
    octree = ball(depth=1.0)
    found = halved(octree)
    assert found.layout.cell == 2 * octree.layout.cell
    assert found.layout.size == (2, 2, 2)
    amounts = [float(o.leaves.depths().sum()) * o.layout.cell**2 for o in (octree, found)]
    assert amounts[1] == pytest.approx(amounts[0], rel=0.05)  # corners that jut out hide a little less
    pictures = [drawn(one, 1) for one in (octree, found)]
    close = psnr(*pictures)
    print(f"PSNR of cells of twice the edge: {close:.1f} dB")
    assert close > 20


def drawn(octree: Octree, camera: int) -> torch.Tensor:
    """Our picture of an octree from a camera."""
    model = DrawnOctree(octree, octree.scene)
    return model.render_view(View(some_cameras()[camera : camera + 1]), torch.ones(3)).rgb


@pytest.mark.medium
def test_a_page_is_as_small_as_asked() -> None:
    """Harmonics go first, then cells become larger, then leaves go; most of the smallest page is its program."""
    torch.manual_seed(0)
    octree, facts = ball(2, depth=1.0), octree_facts(UPRIGHT)
    noise = 20 * torch.randn(octree.leaves.colors.shape)  # which does not compress
    colors = (octree.leaves.colors + noise).round().clamp(0, 255).to(torch.uint8)
    octree = replace(octree, leaves=replace(octree.leaves, colors=colors))
    program = len(page(b"", facts).encode()) / 1e6
    whole, kept, costs = make_octree_page(octree, UPRIGHT, some_cameras(), facts, 30)
    assert kept is octree
    assert costs == []
    assert payload_of(whole) == octree_payload(octree, UPRIGHT)
    before = drawn(octree, 2)
    for share, least in ((0.6, 20.0), (0.2, 15.0), (0.02, 0.0)):
        limit = program + share * (len(whole.encode()) / 1e6 - program)
        text, kept, costs = make_octree_page(octree, UPRIGHT, some_cameras(), facts, limit)
        assert len(text.encode()) <= 1e6 * limit
        close = psnr(drawn(kept, 2), before)
        print(f"{costs[0]}: {close:.1f} dB")
        assert costs[0].startswith(f"{limit:g} MB hold ")
        assert close > least
    assert kept.degree == 0
    assert kept.layout.cell > octree.layout.cell
    with pytest.raises(ConfigError, match="no leaf"):
        make_octree_page(octree, UPRIGHT, some_cameras(), facts, program)


# -- the command --------------------------------------------------------------------------------------------------


@pytest.mark.medium
def test_a_file_of_an_octree_gets_its_page(tmp_path: Path) -> None:
    file, out = tmp_path / "ball.octree", tmp_path / "out"
    write_octree(file, ball())
    done = called("ns-export", "web", file, "--output-dir", out, "--title", "A ball")
    assert done.returncode == 0, done.stderr
    assert f"{ball().layout.num_leaves:,} leaves with harmonics of degree 1" in done.stderr
    assert float(done.stderr.split("PSNR ")[1].split(" dB")[0]) > 90  # nothing is lost
    text = (out / "scene.html").read_text(encoding="utf-8")
    assert "<h1>A ball</h1>" in text
    np.testing.assert_array_equal(read(payload_of(text))["codes"], ball().leaves.codes.numpy())
    picture = iio.imread(out / "scene.jpg")
    assert picture.shape == (PICTURE[1], PICTURE[0], 3)
    assert picture.std() > 5
    half = called("ns-export", "web", file, "--output-dir", out, "--crop-box=-9,-9,0,9,9,9")  # its upper half
    assert half.returncode == 0, half.stderr
    assert f"{ball().layout.num_leaves // 2:,} leaves" in half.stderr
    wrong = called("ns-export", "web", file, "--output-dir", out, "--kind", "gaussians")
    assert wrong.returncode != 0
    assert "give --data" in wrong.stderr  # an octree has rays, but no cameras to fit Gaussians at


@pytest.mark.medium
def test_the_page_of_a_run_of_voxels_is_its_octree(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Not asked for, and made smaller as a file's: harmonics go first, and no leaf."""
    torch.manual_seed(0)
    octree = ball(depth=0.1)
    coefficients = octree.leaves.coefficients() + 0.2 * torch.randn(octree.leaves.colors.shape)
    method = load_method("voxels")
    model = method.build(replace(method.config, **TINY["voxels"]), replace(octree.scene, near=0.05)).eval()
    assert isinstance(model, Voxels)
    model.set_octree(octree.layout, raw_of(octree.leaves.depths())[:, None], coefficients)
    loaded = Loaded(model, octree.placement, "voxels", tmp_path / "x.ckpt", tmp_path / "x.ckpt")
    limit = (len(page(b"", octree_facts(UPRIGHT)).encode()) + 28_000) / 1e6
    export_page(loaded, tmp_path / "x.html", WebSettings(max_megabytes=limit))
    said = capsys.readouterr().err
    assert "MB hold harmonics of degree 0 instead of 1\n" in said
    assert f"{octree.layout.num_leaves:,} leaves with harmonics of degree 0" in said
    assert "baked" not in (tmp_path / "x.html").read_text(encoding="utf-8").split("<noscript>")[0]


@pytest.mark.slow
def test_a_field_is_baked_for_its_page(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=200)
    trainer.train()
    flags = ("--kind", "octree", "--fit-seconds", 3, "--max-megabytes", 1)
    done = called("ns-export", "web", trainer.folder / "config.yml", "--output-dir", tmp_path / "out", *flags)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "scene.html").stat().st_size <= 1e6
    close = float(done.stderr.split("PSNR ")[1].split(" dB")[0])
    print(f"PSNR of the page against the field's pictures: {close} dB")
    assert close > 20  # a white picture has 8

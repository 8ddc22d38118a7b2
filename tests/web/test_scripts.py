"""The web page's program in Node.js, as far as it needs no WebGL: unpacking, and the order of drawing."""

import base64
import json
import math
import shutil
import subprocess
from importlib.resources import files
from typing import Any

import pytest
import torch

from nerfloom.export.levels_page import tree_facts
from nerfloom.levels.cut import cut_of
from nerfloom.levels.nodes import Nodes
from nerfloom.levels.on_image import in_view, sizes_on_image, tangents
from nerfloom.splats.drawing import splat_camera
from nerfloom.splats.look import Look
from nerfloom.splats.spz import encoded
from tests.levels.made import built, camera, cloud
from tests.patience import PATIENCE
from tests.web.helpers import some_gaussians

PAGE = files("nerfloom.export") / "page"
PARTS = ("unpack.js", "webgl.js", "splats.js", "levels.js", "motion.js")
VECTORS = """
const add = (a, b, times = 1) => [a[0] + times * b[0], a[1] + times * b[1], a[2] + times * b[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
"""
"""Functions of viewer.js, which needs a page."""


def run(code: str, given: Any) -> Any:
    """Run JavaScript behind the page's functions; it answers by `answer(value)`, and `given` is its input."""
    if (node := shutil.which("node")) is None:
        pytest.skip("there is no Node.js; the page's program is not run")
    program = "".join((PAGE / name).read_text(encoding="utf-8") for name in PARTS)
    start = f"const given = {json.dumps(given)}, answer = (value) => console.log(JSON.stringify(value));\n"
    done = subprocess.run([node, "-"], input=program + start + code, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("plain", [True, False])
def test_a_file_with_a_comment_is_unpacked(plain: bool) -> None:
    """Our own inflate and the browser's both give the written centres."""
    given = some_gaussians(50)
    content = base64.b64encode(encoded(given, look=Look(True, 0.1, "depth"))).decode()
    code = "gunzip(bytesOf(given.content), given.plain).then((raw) => answer([...gaussiansOf(raw).centers]));"
    found = torch.tensor(run(code, {"content": content, "plain": plain})).view(-1, 3)
    torch.testing.assert_close(found, given.means, atol=1e-3, rtol=0)


def test_the_order_is_by_distance_or_by_depth() -> None:
    """Two chunks are in their places in the table; a third is not shown."""
    means = some_gaussians(300).means.double()
    eye, axis = torch.tensor([2.0, -1.0, 0.5]).double(), torch.tensor([-0.8, 0.0, -0.6]).double()
    code = (
        "const held = sorter(), part = (a, b) => Float32Array.from(given.centers.slice(3 * a, 3 * b));"
        "held.add('a', part(0, 100), 1024); held.add('b', part(100, 300), 0); held.add('c', part(0, 50), 2048);"
        "held.sort({ eye: [0, 0, 0], axis: null, ids: ['c'] });"
        "answer([null, given.axis].map((axis) => [...held.sort({ eye: given.eye, axis, ids: ['a', 'b'] })]));"
    )
    given = {"centers": means.flatten().tolist(), "eye": eye.tolist(), "axis": axis.tolist()}
    places = torch.cat([1024 + torch.arange(100), torch.arange(200)])
    by_distance, by_depth = run(code, given)
    assert by_distance == places[(means - eye).norm(dim=-1).argsort(descending=True)].tolist()
    depths = (means - eye) @ axis
    shown = int((depths > 0).sum())
    assert 0 < shown <= 300
    assert by_depth[:shown] == places[depths.argsort(descending=True)[:shown]].tolist()
    assert sorted(by_depth) == sorted(places.tolist())


@pytest.fixture(scope="module")
def nodes(tmp_path_factory: pytest.TempPathFactory) -> Nodes:
    return built(tmp_path_factory.mktemp("levels") / "x.levels", cloud()).nodes


def facts_of(nodes: Nodes) -> dict[str, Any]:
    return tree_facts(nodes, torch.eye(3).double(), 1.0, torch.zeros(3).double())


@pytest.mark.parametrize(("distance", "turn"), [(6.0, 0.0), (2.0, 0.4), (0.4, 0.8), (3.0, 3.1)])
def test_the_cut_of_levels_is_ours(nodes: Nodes, distance: float, turn: float) -> None:
    """The memory is enough or too little; no node that an image may show is left out."""
    seen_by = camera(distance, turn=turn)
    ours = splat_camera(seen_by, 0.01)
    seen, sizes = in_view(nodes.boxes, ours, tangents(seen_by, 0.3)), sizes_on_image(nodes, ours, 0.01)
    rotation, shift = ours.pose[:, :3].double(), ours.pose[:, 3].double()
    fx, fy, cx, cy = ours.intrinsics
    looks = {"eye": (-rotation.T @ shift).tolist(), "turn": rotation.flatten().tolist()}
    looks |= {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
    code = VECTORS + (
        "const tree = treeOf(given.tree), seen = tree.inView(given.camera, 64, 64, 1.9);"
        "answer([seen, tree.sizes(given.camera, 0.01),"
        " given.most.map((most) => cutOf(tree, given.sizes, given.seen, 1, most, 1e9))]);"
    )
    most = [10**9, 1500, 300, 50]
    given = {"tree": facts_of(nodes), "camera": looks, "seen": seen.tolist(), "sizes": sizes.tolist(), "most": most}
    in_page, on_page, cuts = run(code, given)
    assert not bool((seen & ~torch.tensor(in_page)).any())
    torch.testing.assert_close(torch.tensor(on_page).double(), sizes, rtol=1e-2, atol=1e-6)
    for limit, cut in zip(most, cuts, strict=True):
        assert cut == cut_of(nodes, sizes, seen, 1.0, limit).nodes


def test_few_nodes_are_a_coarser_cut(nodes: Nodes) -> None:
    given = {"tree": facts_of(nodes), "sizes": (1e4 * nodes.errors).tolist()}
    code = "const tree = treeOf(given.tree); answer(cutOf(tree, given.sizes, tree.counts.map(() => true), 1, 1e9, 8));"
    assert 1 < len(run(code, given)) <= 8


def test_what_is_missing_is_shown_by_what_is_above_it(nodes: Nodes) -> None:
    """Each node of a cut is shown once, by itself or by a node above it that is there."""
    random, cut = torch.Generator().manual_seed(0), nodes.is_leaf.nonzero()[:, 0].tolist()
    there = (torch.rand(len(nodes), generator=random) < 0.6).tolist()
    there[-1] = True
    code = (
        "const tree = treeOf(given.tree), all = tree.counts.map(() => true), cut = new Set(given.cut);"
        "answer([all, given.there].map((there) => coverOf(tree, cut, all, (node) => there[node])));"
    )
    whole, cover = run(code, {"tree": facts_of(nodes), "cut": cut, "there": there})
    assert sorted(whole) == cut
    assert all(there[node] for node in cover)
    parents = nodes.parents.tolist()
    for node in cut:
        above = [node]
        while parents[above[-1]] >= 0:
            above.append(parents[above[-1]])
        assert len(set(above) & set(cover)) == 1


@pytest.mark.parametrize("angles", [(0.0, 90.0, 0.0), (30.0, 90.0, 0.0), (200.0, 50.0, -30.0), (10.0, -20.0, 80.0)])
def test_a_phone_aims_where_its_back_points(angles: tuple[float, float, float]) -> None:
    """The rotations are about z, x and y, in the order of the specification."""
    a, b, c = (math.radians(angle) for angle in angles)
    about_z = torch.tensor([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]])
    about_x = torch.tensor([[1, 0, 0], [0, math.cos(b), -math.sin(b)], [0, math.sin(b), math.cos(b)]])
    about_y = torch.tensor([[math.cos(c), 0, math.sin(c)], [0, 1, 0], [-math.sin(c), 0, math.cos(c)]])
    yaw, pitch = run("answer(aimOf(given));", dict(zip(("alpha", "beta", "gamma"), angles, strict=True)))
    found = [math.cos(pitch) * math.cos(yaw), math.cos(pitch) * math.sin(yaw), math.sin(pitch)]
    torch.testing.assert_close(torch.tensor(found), -(about_z @ about_x @ about_y)[:, 2], atol=1e-5, rtol=0)

"""The web page's program in Node.js, as far as it needs no WebGL: what it unpacks, and the order of drawing."""

import base64
import json
import shutil
import subprocess
from importlib.resources import files
from typing import Any

import pytest
import torch

from nerfloom.splats.look import Look
from nerfloom.splats.spz import encoded
from tests.patience import PATIENCE
from tests.web.helpers import some_gaussians

PAGE = files("nerfloom.export") / "page"


def run(code: str, given: Any) -> Any:
    """Run JavaScript behind the page's functions; it answers by `answer(value)`, and `given` is what it is given."""
    if (node := shutil.which("node")) is None:
        pytest.skip("there is no Node.js; the page's program is not run")
    program = "".join((PAGE / name).read_text(encoding="utf-8") for name in ("unpack.js", "webgl.js", "splats.js"))
    start = f"const given = {json.dumps(given)}, answer = (value) => console.log(JSON.stringify(value));\n"
    done = subprocess.run([node, "-"], input=program + start + code, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("plain", [True, False])
def test_a_file_with_a_comment_is_unpacked(plain: bool) -> None:
    """By our own inflate, and by the browser's: the centres are those that were written."""
    given = some_gaussians(50)
    content = base64.b64encode(encoded(given, look=Look(True, 0.1, "depth"))).decode()
    code = "gunzip(bytesOf(given.content), given.plain).then((raw) => answer([...gaussiansOf(raw).centers]));"
    found = torch.tensor(run(code, {"content": content, "plain": plain})).view(-1, 3)
    torch.testing.assert_close(found, given.means, atol=1e-3, rtol=0)


def test_the_order_is_by_distance_or_by_depth() -> None:
    means = some_gaussians(300).means.double()
    eye, axis = torch.tensor([2.0, -1.0, 0.5]).double(), torch.tensor([-0.8, 0.0, -0.6]).double()
    code = (
        "const sort = sorter(Float32Array.from(given.centers));"
        "answer([null, given.axis].map((axis) => [...sort({ eye: given.eye, axis })]));"
    )
    given = {"centers": means.flatten().tolist(), "eye": eye.tolist(), "axis": axis.tolist()}
    by_distance, by_depth = run(code, given)
    assert by_distance == (means - eye).norm(dim=-1).argsort(descending=True).tolist()
    depths = (means - eye) @ axis
    shown = int((depths > 0).sum())
    assert 0 < shown <= 300
    assert by_depth[:shown] == depths.argsort(descending=True)[:shown].tolist()
    assert sorted(by_depth) == list(range(300))

"""Python in the documents runs: in the order of its page, on a run of a few steps."""

import itertools
import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.site.pages import PAGES, ROOT, Block, blocks
from tests.training.helpers import TINY

EXECUTED = ("guides/camera-paths", "python/index")
"""Pages with Python that needs a run at most. Other pages: plug-and-play in tests/plug_and_play, those below, and
signatures, which are not programs."""
RUN = "outputs/lego/instant-ngp/TIME"


def python(page: str) -> list[Block]:
    return [block for block in blocks(ROOT / "docs" / f"{page}.md") if block.language == "python"]


def run_block(block: Block, names: dict[str, Any]) -> None:
    exec(compile("\n" * block.line + block.text, block.page, "exec"), names)


@pytest.fixture
def trained(shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with the documents' run, where training takes a few steps."""
    import nerfloom

    monkeypatch.chdir(tmp_path)
    small = {**TINY.get("instant-ngp", {}), "vis": "none", "max_num_iterations": 10, "data": shared_tiny}
    train = nerfloom.train
    monkeypatch.setattr(nerfloom, "train", lambda method, **settings: train(method, **{**settings, **small}))
    nerfloom.train("instant-ngp", output_dir="outputs", experiment_name="lego", timestamp="TIME")
    assert Path(RUN, "config.yml").is_file()
    return tmp_path


@pytest.mark.medium
@pytest.mark.parametrize("page", EXECUTED)
def test_it_runs(page: str, trained: Path) -> None:
    names: dict[str, Any] = {}
    for block in python(page):
        run_block(block, names)
    assert names["picture"].rgb.shape == (20, 20, 3)
    assert names["picture"].depth.isfinite().all()


def test_the_format_of_the_guide_reads_what_it_describes(shared_tiny: Path, tmp_path: Path) -> None:
    (source,) = python("guides/add-a-format")
    names: dict[str, Any] = {"__name__": "ring"}
    run_block(source, names)
    photographs = sorted(shared_tiny.rglob("*.png"))[:8]
    content = {"images": [str(path) for path in photographs], "fov": 40.0}
    (tmp_path / "ring.json").write_text(json.dumps(content))
    ring = names["Ring"](radius=3.0)
    assert ring.recognizes(tmp_path)
    assert not ring.recognizes(shared_tiny)
    train, test = ring.parse(tmp_path, "train"), ring.parse(tmp_path, "test")
    assert (len(train.image_paths), len(test.image_paths)) == (6, 2)
    assert set(train.image_paths) | set(test.image_paths) == set(photographs)
    poses = train.cameras.camera_to_worlds
    rotations = poses[..., :3]
    torch.testing.assert_close(rotations @ rotations.mT, torch.eye(3).expand(6, 3, 3))
    torch.testing.assert_close(torch.linalg.det(rotations), torch.ones(6))
    torch.testing.assert_close(poses[..., 3].norm(dim=-1), torch.full((6,), 3.0))
    # Each camera looks at the middle: from its position along -z for the radius.
    torch.testing.assert_close(poses[..., 3] - 3.0 * poses[..., 2], torch.zeros(6, 3), atol=1e-6, rtol=0)
    assert train.cameras.fx[0].item() == pytest.approx(10 / math.tan(math.radians(20)))


@pytest.mark.slow
def test_the_method_of_the_guide_is_checked_as_it_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    method, check = python("guides/add-a-method")
    (tmp_path / "my_file.py").write_text(method.text, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    run_block(check, {})
    assert capsys.readouterr().out.count("\n") > 15


def test_all_can_be_compiled() -> None:
    for block in itertools.chain.from_iterable(map(blocks, PAGES)):
        assert block.language in ("", "text", "python", "py", "toml", "sh", "bash", "diff", "json", "yaml"), block.where
        if block.language in ("python", "py"):
            compile(block.text, block.where, "exec")


def test_pages_with_programs_are_executed() -> None:
    """Python that calls `nerfloom` or makes a METHOD is run by some test, not only compiled."""
    run_elsewhere = {
        "check-plugins",
        "plug-and-play-loop",
        "plug-and-play-more",
        "plug-and-play-samplers",
        "guides/add-a-format",
        "guides/add-a-method",
        "guides/edit",
        "guides/judge-geometry",
        "guides/measure",
        "interfaces",
    }
    pages = {block.page for page in PAGES for block in blocks(page) if block.language == "python"}
    assert pages == {f"docs/{name}.md" for name in {*EXECUTED, *run_elsewhere}}

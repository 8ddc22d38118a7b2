"""ns-blocks from outside: a short street in two blocks, opened by everything that takes a run."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

import nerfloom
from nerfloom.blocks.composed import Blocks
from nerfloom.blocks.files import read_blocks
from nerfloom.cameras.camera_path import read_transforms
from nerfloom.rendering.light import STOPS, ToneLight
from nerfloom.training.loaded import Loaded
from nerfloom.training.run import TRANSFORMS, read_run
from nerfloom.viewer.browser import Browser
from nerfloom.viewer.photographs import Photographs
from nerfloom.viewer.render_queue import RenderQueue
from nerfloom.viewer.request import Pose, Request
from tests.cli.helpers import called

SMALL = "--num-levels 4 --max-resolution 64 --log2-table-size 12 --grid-resolution 16 --num-steps 64"
NGP = f"instant-ngp {SMALL} --samples-per-batch 4096 --appearance tone"
STREET = "--data-flags=--street 2 --size 24 --num-train 18 --changing-exposure True"
SPLIT = ("--max-cameras", 12, "--min-cameras", 3, "--overlap", 0.2)
FLAGS = ("--method", NGP, STREET, *SPLIT, "--max-num-iterations", 12, "--num-threads", 1, "--device-type", "cpu")


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a scene in two blocks."""
    folder = tmp_path_factory.mktemp("town") / "town"
    done = called("ns-blocks", *FLAGS, "--output-dir", folder)
    assert done.returncode == 0, done.stderr
    assert "block 000: " in done.stderr
    assert "2 of 2 blocks" in done.stderr
    assert "visibility network 2 of 2: " in done.stderr
    return folder


@pytest.fixture(scope="module")
def loaded(town: Path) -> Loaded:
    return nerfloom.load(town, device="cpu")


@pytest.mark.slow
def test_every_training_image_is_in_a_block_and_each_block_has_room_of_its_own(town: Path) -> None:
    found = read_blocks(town / "blocks.yml")
    assert {camera for block in found.blocks for camera in block.cameras} == set(range(18))
    assert all(len(block.cameras) <= 12 for block in found.blocks)
    whole = read_transforms(town / TRANSFORMS)
    for block in found.blocks:
        own = read_transforms(block.run / TRANSFORMS)
        assert own.scale > 1.3 * whole.scale
        torch.testing.assert_close(own.transform[:, :3], whole.transform[:, :3])
        run = read_run(block.run)
        assert run.config.train_image_indices == block.cameras
        parsed = run.parse("train")
        assert len(parsed.image_paths) == len(block.cameras)
        assert float(parsed.cameras.camera_to_worlds[:, :, 3].abs().max()) == pytest.approx(1, abs=0.1)


@pytest.mark.slow
def test_it_is_opened_like_a_run(town: Path, loaded: Loaded) -> None:
    assert isinstance(loaded.model, Blocks)
    assert loaded.method == "instant-ngp"
    picture = loaded.render(loaded.views("test")[3])
    assert picture.size == (24, 24)
    assert bool(picture.rgb.isfinite().all())
    assert len(loaded.run.parse("train").image_paths) == 18


@pytest.mark.slow
def test_visibility_networks_decide_which_blocks_are_drawn(town: Path, loaded: Loaded) -> None:
    model = loaded.model
    assert isinstance(model, Blocks)
    for number, block in enumerate(read_blocks(town / "blocks.yml").blocks):
        network = model.visibility(number)
        assert network is not None
        assert (network.center, network.radius) == (block.center, block.radius)
        assert (block.run / "visibility.npz").is_file()


@pytest.mark.slow
def test_each_block_learns_the_light_of_its_own_images(town: Path, loaded: Loaded) -> None:
    """From the exposures that the street states, relative to the block's mean."""
    taken = loaded.run.parse("train").taken
    assert taken is not None
    for block in read_blocks(town / "blocks.yml").blocks:
        light = nerfloom.load(block.run, device="cpu").model.appearance
        assert isinstance(light, ToneLight)
        stated = torch.tensor([taken[camera].stops for camera in block.cameras])
        assert float(stated.std()) > 0.1
        torch.testing.assert_close(STOPS * light.start, stated - stated.mean(), atol=1e-5, rtol=0)
        learnt = STOPS * (light.vectors[:, 0].detach() - light.start).abs()
        assert 0 < float(learnt.max()) < 1


@pytest.mark.slow
def test_the_viewer_shows_it_among_its_photographs(loaded: Loaded) -> None:
    photographs, queue = Photographs(loaded.source, lambda: loaded.model), RenderQueue(loaded)
    assert photographs.cameras is not None
    assert len(photographs.cameras) == 18
    pictures, pose = list[np.ndarray](), Pose(tuple(photographs.pose(5).flatten().tolist()), photographs.fov(5))
    assert photographs.at(pose) == 5
    request = Request(pose, 24, 24)
    queue.add(1, Browser(lambda image, quality: pictures.append(image)))
    queue.ask(1, lambda _: request)
    while queue.draw_next() is not None or queue._browsers[1].pieces:
        pass
    expected = loaded.render(loaded.views("train")[5]).rgb.clamp(0, 1)
    assert float(np.abs(pictures[-1] / 255 - expected.numpy()).mean()) < 0.005


@pytest.mark.slow
def test_a_picture_is_that_of_its_blocks(loaded: Loaded) -> None:
    """Each block is loaded as a run of its own, and shown the camera by way of the input's frame."""
    model, view = loaded.model, loaded.views("test")[7]
    assert isinstance(model, Blocks)
    background = model.background
    shares = model.shares(view, background)
    assert sum(shares.values()) == pytest.approx(1)
    expected = torch.zeros(24, 24, 3)
    for number, share in shares.items():
        run = nerfloom.load(model.blocks[number].run, device="cpu")
        pose = run.placement.poses(loaded.placement.original_poses(view.camera.camera_to_worlds)).float()
        own = nerfloom.View(dataclasses.replace(view.camera, camera_to_worlds=pose))
        shown = run.model.render_view(own, background)
        color = torch.tensor(model.blocks[number].color)
        behind = (1 - shown.accumulation)[..., None] * background
        inner = torch.cat([shown.rgb - behind, shown.accumulation[..., None]], dim=-1)
        expected += share * (inner @ color.T + behind)
    torch.testing.assert_close(model.render_view(view, background).rgb, expected, atol=2e-3, rtol=0)


@pytest.mark.slow
def test_commands_that_take_a_run_take_it(town: Path, tmp_path: Path) -> None:
    done = called("ns-eval", town / "blocks.yml", "--max-images", 2, "--device-type", "cpu")
    assert done.returncode == 0, done.stderr
    assert math.isfinite(json.loads((town / "blocks.eval.json").read_text())["results"]["psnr"])
    flags = ("--output-path", tmp_path / "flight", "--num-frames", 2, "--downscale-factor", 2)
    done = called("ns-render", "interpolate", town, *flags)
    assert done.returncode == 0, done.stderr
    assert len(list((tmp_path / "flight").glob("*.png"))) == 2
    done = called("ns-export", "cameras", town, "--output-dir", tmp_path)
    assert done.returncode == 0, done.stderr
    for words, said in (
        (("ns-eval", town, "--eval-appearance", "nearest"), "--eval-appearance has no effect with a scene in blocks"),
        (("ns-eval", town, "--up", "x"), "--up is for files of Gaussians"),
        (("ns-export", "marching-cubes", town, "--output-dir", tmp_path), "has no density"),
        (("ns-export", "gaussian-splat", town, "--output-dir", tmp_path), "has no Gaussians"),
    ):
        done = called(*words)
        assert done.returncode == 1
        assert said in done.stderr


@pytest.mark.slow
def test_a_second_call_only_does_what_is_missing(town: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in (town / "runs").rglob("*.ckpt")}
    again = called("ns-blocks", *FLAGS, "--output-dir", town)
    assert again.returncode == 0, again.stderr
    assert again.stderr.count("already finished") == 2
    assert before == {path: path.stat().st_mtime_ns for path in (town / "runs").rglob("*.ckpt")}
    other = called("ns-blocks", *FLAGS[:3], "--max-cameras", 18, *FLAGS[5:], "--output-dir", town)
    assert other.returncode == 1
    assert "blocks of another plan" in other.stderr


@pytest.mark.medium
def test_blocks_can_be_looked_at_before_they_are_trained(tmp_path: Path) -> None:
    done = called("ns-blocks", STREET, "--block-size", 1.5, "--min-cameras", 6, "--only-split", True, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("images around (") >= 2
    assert not (tmp_path / "outputs").exists()
    done = called("ns-blocks", STREET, "--min-cameras", 100, "--only-split", True, folder=tmp_path)
    assert done.returncode == 1
    assert "no block has 100 images" in done.stderr


@pytest.mark.parametrize(
    ("flags", "status", "reason"),
    [
        (("--overlap", 1), 2, "--overlap is 1"),
        (("--block-size", 0), 2, "--block-size is 0"),
        (("--min-cameras", 20, "--max-cameras", 10), 2, "--max-cameras 10"),
        (("--method", ""), 2, "--method: '' names no method"),
        (("--method", "nerfactor"), 1, "Did you mean 'nerfacto'"),
        (("--data", "/no/such/folder"), 1, "there is no such folder"),
        (("--method", "nerfacto --max-train-images 3"), 2, "leave out --train-image-indices and --max-train-images"),
        (("--method", 'nerfacto "'), 1, "--method"),
    ],
)
def test_what_cannot_be_divided(flags: tuple[object, ...], status: int, reason: str, tmp_path: Path) -> None:
    done = called("ns-blocks", *flags, folder=tmp_path)
    assert done.returncode == status
    assert reason in done.stderr.replace("\n", " ")
    assert "Traceback" not in done.stderr

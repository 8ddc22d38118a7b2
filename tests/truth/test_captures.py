"""A capture with a known truth, in every format: pixels, depths, bounds and splits after it has been read."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nerfloom import Cameras, ParsedScene
from nerfloom.base.splits import Split
from nerfloom.cameras.poses import estimate_near
from nerfloom.data.dataset import Dataset, load_dataset
from nerfloom.data.depths import read_depth
from nerfloom.dataparsers.nerfstudio import Nerfstudio
from nerfloom.geometry.rays import Rays
from tests.truth.ball import CENTRE, HEIGHT, NAMES, RADIUS, WIDTH, met
from tests.truth.formats import FORMATS, write_nerfstudio

SURE = 0.06
"""How much of a radius squared from the outline pixels lie that are looked at."""
Captured = tuple[str, Path]


@pytest.fixture(scope="module", params=FORMATS)
def captured(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Captured:
    """A format's name, and the folder of the capture."""
    return request.param, FORMATS[request.param].write(tmp_path_factory.mktemp("capture"))


def in_own_frame(scene: ParsedScene, rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions of rays of the scene in the capture's own frame and unit, by the scene's account."""
    transform = np.eye(4)[:3] if scene.transform is None else scene.transform.double().numpy()
    turn, move = transform[:, :3], transform[:, 3]
    return (rays.origins.double().numpy() / scene.scale - move) @ turn, rays.directions.double().numpy() @ turn


def assert_pixels_show_the_ball(scene: ParsedScene, steps: float | None) -> Dataset:
    """Check that every pixel has the colour, the alpha and the depth of its ray's first hit."""
    data = load_dataset(scene, "a")
    for index in range(len(data)):
        pixels = data.cameras.image_pixels(index)
        stored = data.image(index).view(len(pixels), -1).numpy() / 255
        for make in (data.cameras.pixel_rays, data.cameras.pixel_rays_reference):
            origins, directions = in_own_frame(scene, make(pixels, 0.0, 10.0))
            colors, distances, margins = met(origins, directions)
            inside = margins > SURE
            assert inside.sum() > 100
            assert np.abs(stored[inside, :3] - colors[inside]).max() < 1.5 / 255
            assert (stored[inside, 3] == 1).all()
            assert (stored[margins < -SURE, 3] == 0).all()
        if steps is not None:
            assert data.depths is not None
            turn = np.eye(3) if scene.transform is None else scene.transform[:, :3].double().numpy()
            axis = -data.cameras.camera_to_worlds[index, :, 2].double().numpy() @ turn
            found = data.depths[pixels].double().numpy()[inside] / scene.scale
            np.testing.assert_allclose(found, (distances * (directions @ axis))[inside], rtol=1e-3, atol=1 / steps)
    return data


def test_every_pixel_shows_what_its_ray_meets(captured: Captured) -> None:
    name, folder = captured
    scene = FORMATS[name].parser.parse(folder, "train")
    data = assert_pixels_show_the_ball(scene, FORMATS[name].steps)
    assert data.scene.has_depth == (FORMATS[name].steps is not None)


def test_what_is_judged_is_not_learnt_from(captured: Captured) -> None:
    name, folder = captured
    expected = FORMATS[name]
    splits: tuple[Split, ...] = ("train", "val", "test")
    found = {split: tuple(p.stem for p in expected.parser.parse(folder, split).image_paths) for split in splits}
    assert found == {"train": expected.train, "val": expected.val, "test": expected.test}
    assert not set(found["train"]) & (set(found["val"]) | set(found["test"]))


def test_all_splits_are_placed_alike_and_rays_begin_before_the_ball_and_end_behind_it(captured: Captured) -> None:
    name, folder = captured
    train, test = (FORMATS[name].parser.parse(folder, split) for split in ("train", "test"))
    assert train.scale == test.scale
    if train.transform is not None:
        assert test.transform is not None
        assert torch.equal(train.transform, test.transform)
    places = np.concatenate([in_own_frame(s, _axes(s))[0] for s in (train, test)])
    away = np.linalg.norm(places - CENTRE, axis=-1) * train.scale
    assert train.near <= away.min() - RADIUS * train.scale
    assert train.far >= away.max() + RADIUS * train.scale


def _axes(scene: ParsedScene) -> Rays:
    indices = torch.arange(len(scene.cameras))
    return scene.cameras.rays(indices, torch.zeros(len(indices)), torch.zeros(len(indices)), 0.0, 1.0)


@pytest.mark.parametrize("name", ["nerfstudio", "blender", "llff", "polycam"])
def test_a_scale_is_one_of_all_lengths(name: str, tmp_path: Path) -> None:
    """Twice as large: cameras, box, near, depth. How far rays go at most is a flag of captures, in scene units."""
    folder, parser = FORMATS[name].write(tmp_path), FORMATS[name].parser
    if name == "llff":
        one, two = (type(parser)(scale_factor=factor).parse(folder, "train") for factor in (1.0, 2.0))
        assert two.near == pytest.approx(2 * one.near)
        away = np.linalg.norm(in_own_frame(one, _axes(one))[0] - CENTRE, axis=-1) * one.scale
        assert one.near == pytest.approx(0.9 * (away.min() - RADIUS * one.scale), rel=0.2)
    else:
        one, two = (replace(parser, scale_factor=factor).parse(folder, "train") for factor in (1.0, 2.0))
    assert two.scale == pytest.approx(2 * one.scale)
    centres = [scene.cameras.camera_to_worlds[:, :, 3] for scene in (one, two)]
    torch.testing.assert_close(centres[1], 2 * centres[0])
    if name == "blender":
        assert (two.near, two.far) == (2 * one.near, 2 * one.far)
        torch.testing.assert_close(two.box, 2 * one.box)


def test_the_word_for_held_out_photographs_is_looked_for_in_their_own_names(tmp_path: Path) -> None:
    """All photographs in a folder called latest/ would be held out."""
    folder = write_nerfstudio(tmp_path / "valley")
    (folder / "images").rename(folder / "latest")
    (folder / "latest" / NAMES[3]).rename(folder / "latest" / f"eval_{NAMES[3]}")
    content = json.loads((folder / "transforms.json").read_text())
    for frame in content["frames"]:
        name = Path(frame["file_path"]).name
        frame["file_path"] = f"latest/eval_{name}" if name == NAMES[3] else f"latest/{name}"
    (folder / "transforms.json").write_text(json.dumps(content))
    parser = Nerfstudio(eval_mode="filename")
    assert [path.name for path in parser.parse(folder, "test").image_paths] == [f"eval_{NAMES[3]}"]
    assert len(parser.parse(folder, "train").image_paths) == len(NAMES) - 1


@pytest.mark.parametrize(("rows", "columns"), [(HEIGHT // 2, WIDTH // 2), (3 * HEIGHT, 3 * WIDTH), (HEIGHT, 3 * WIDTH)])
def test_a_depth_image_of_another_size_gives_what_is_at_the_pixels_middle(
    rows: int, columns: int, tmp_path: Path
) -> None:
    """A ramp along both axes: half of one of its pixels that everything is shifted by shows."""
    ramp = np.arange(rows)[:, None] * 1000.0 + np.arange(columns)
    np.save(tmp_path / "d.npy", ramp)
    found = read_depth(tmp_path / "d.npy", WIDTH, HEIGHT)
    down = np.floor((np.arange(HEIGHT) + 0.5) * rows / HEIGHT)
    across = np.floor((np.arange(WIDTH) + 0.5) * columns / WIDTH)
    assert np.array_equal(found, (down[:, None] * 1000 + across).astype(np.float32))


def test_points_behind_a_camera_do_not_say_where_its_rays_begin() -> None:
    """A camera at the origin that looks along -z: it does not show points right behind it."""
    numbers = torch.full((1,), 50.0)
    camera = Cameras(torch.eye(4)[None, :3], numbers, numbers, numbers / 2, numbers / 2, numbers.long(), numbers.long())
    ahead, behind = torch.tensor([[0.0, 0.0, -4.0]]).repeat(9, 1), torch.tensor([[0.0, 0.0, 0.1]]).repeat(9, 1)
    assert estimate_near(camera, torch.cat([ahead, behind])) == pytest.approx(0.5 * 4)


def test_what_goes_with_a_photograph_goes_with_it_where_others_are_missing(tmp_path: Path) -> None:
    """Its time, its depth and its pose; a missing file, one that cannot be read and those held out are left out."""
    folder = write_nerfstudio(tmp_path)
    content = json.loads((folder / "transforms.json").read_text())
    for frame in content["frames"]:
        frame["time"] = NAMES.index(Path(frame["file_path"]).name) / len(NAMES)
    (folder / "transforms.json").write_text(json.dumps(content))
    (folder / "images" / NAMES[2]).unlink()
    (folder / "images" / NAMES[5]).write_bytes(b"no picture")
    scene = Nerfstudio().parse(folder, "train")
    data = load_dataset(scene, "train")
    # Every eighth of the existing files.
    there = [name for name in NAMES if name != NAMES[2]]
    assert list(data.names) == [name for name in there if name not in (there[0], there[8], NAMES[5])]
    assert data.times is not None
    assert data.times.tolist() == pytest.approx([NAMES.index(name) / len(NAMES) for name in data.names])
    kept = torch.tensor([index for index, path in enumerate(scene.image_paths) if path.name != NAMES[5]])
    assert_pixels_show_the_ball(scene[kept], 1000.0)

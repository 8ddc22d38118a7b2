"""A capture whose truth is known, in every format: pixels, depths, bounds and splits after it has been read."""

from pathlib import Path

import numpy as np
import pytest
import torch

from framework import ParsedScene
from framework.dataset import Dataset, Split, load_dataset
from framework.rays import Rays
from tests.truth.ball import CENTRE, RADIUS, met
from tests.truth.formats import FORMATS

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
    """Every pixel has the colour, the alpha and the depth of what its ray meets."""
    data = load_dataset(scene, "a")
    for index in range(len(data)):
        pixels = data.cameras.image_pixels(index)
        stored = data.image(index).view(len(pixels), -1).numpy() / 255
        for make in (data.cameras.pixel_rays, data.cameras.pixel_rays_reference):
            origins, directions = in_own_frame(scene, make(pixels, 0.0, 10.0))
            colors, distances, surely = met(origins, directions)
            inside = surely > SURE
            assert inside.sum() > 100
            assert np.abs(stored[inside, :3] - colors[inside]).max() < 1.5 / 255
            assert (stored[inside, 3] == 1).all()
            assert (stored[surely < -SURE, 3] == 0).all()
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

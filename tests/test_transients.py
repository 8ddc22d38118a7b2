"""--robust auto: photographs that others contradict, in a made-up courtyard with things that stand in single images."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from nerfloom.data.dataset import Dataset
from nerfloom.data.scene import Scene
from nerfloom.registry import load_method
from nerfloom.scene.transients import in_blocks, transient_share
from nerfloom.testing.ball import cameras_at, trace
from nerfloom.training.preparation import decided
from nerfloom.training.robust_choice import CLEAR

COUNT, SIZE = 14, 48
"""Photographs along an arc, and their width and height, pixels."""


def courtyard(turn: float = 4.0) -> Dataset:
    """Photographs of a ball on a floor with a pattern, `turn` degrees apart."""
    angles = torch.arange(COUNT) * math.radians(turn)
    places = 3 * torch.stack([angles.cos(), angles.sin(), torch.ones(COUNT)], -1)
    cameras = cameras_at(places, 40.0, SIZE)
    rays = cameras.pixel_rays(torch.arange(COUNT * SIZE * SIZE), 0.0, 1.0)
    normals, hits = trace(rays.origins, rays.directions, torch.zeros(3))
    below = rays.origins + rays.directions * ((-1 - rays.origins[:, 2:]) / rays.directions[:, 2:])
    x, y, _ = below.unbind(-1)
    floor = 0.5 + 0.2 * torch.stack([(3 * x).sin(), (3 * y).cos(), (2 * x + 2 * y).sin()], -1)
    colors = torch.where(hits[:, None], 0.5 + 0.2 * normals, floor)
    scene = Scene(
        box=torch.tensor([[-2.0, -2.0, -2.0], [2.0, 2.0, 2.0]]),
        near=0.05,
        far=1000.0,
        num_cameras=COUNT,
        has_alpha=False,
        moving=False,
        image_size=SIZE,
        unbounded=True,
        poses="photographs",
        camera_to_worlds=cameras.camera_to_worlds,
    )
    paths = tuple(Path(f"{index}.png") for index in range(COUNT))
    eye = torch.eye(4, dtype=torch.float64)[:3]
    return with_colors(Dataset(colors, cameras, None, paths, scene, eye, 1.0), colors)


def with_colors(dataset: Dataset, colors: Tensor) -> Dataset:
    """The same photographs with colours (P, 3)."""
    return dataclasses.replace(dataset, pixels=(colors.clamp(0, 1) * 255).round().to(torch.uint8))


def covered(dataset: Dataset, side: int, images: range = range(COUNT)) -> Dataset:
    """The photographs with a square of `side` pixels in some of them, each of another colour and at another place."""
    generator = torch.Generator().manual_seed(0)
    pixels = dataset.pixels.clone().view(COUNT, SIZE, SIZE, 3)
    for index in images:
        row, column = torch.randint(4, SIZE - side - 4, (2,), generator=generator).tolist()
        pixels[index, row : row + side, column : column + side] = torch.tensor(
            [250 * (index % 2), 250 * (index // 2 % 2), 250 * (index // 4 % 2)], dtype=torch.uint8
        )
    return dataclasses.replace(dataset, pixels=pixels.view(-1, 3))


STILL = courtyard()
LIGHT = 2 ** torch.linspace(-0.5, 0.5, COUNT).repeat_interleave(SIZE * SIZE)[:, None]
NOISE = 0.03 * torch.randn(COUNT * SIZE * SIZE, 3, generator=torch.Generator().manual_seed(1))
SHINE = 1 + 0.1 * torch.sin(torch.arange(COUNT)[:, None] + torch.linspace(0, 6, SIZE * SIZE)).view(-1, 1)


def found(dataset: Dataset) -> float:
    share = transient_share(dataset)
    assert share is not None
    return share


@pytest.mark.parametrize("side", [9, 12, 18])
@pytest.mark.parametrize("light", [False, True])
def test_the_share_of_things_that_stand_in_single_photographs_is_found(side: int, light: bool) -> None:
    dataset = with_colors(STILL, STILL.pixels / 255 * LIGHT) if light else STILL
    share = found(covered(dataset, side))
    assert (side / SIZE) ** 2 < share < ((side + 4) / SIZE) ** 2  # means over 3 x 3 pixels widen it


@pytest.mark.parametrize("factor", [1.0, LIGHT, 1 + NOISE, SHINE], ids=["still", "exposure", "noise", "shine"])
def test_nothing_is_found_where_nothing_moves(factor: Any) -> None:
    assert found(with_colors(STILL, STILL.pixels / 255 * factor)) < CLEAR / 2


def test_a_thing_in_few_photographs_is_missed_and_photographs_far_apart_are_not_judged() -> None:
    assert found(covered(STILL, 18, range(0, COUNT, 4))) < CLEAR
    assert transient_share(courtyard(turn=20.0)) is None
    looking_apart = STILL.cameras.camera_to_worlds.clone()
    looking_apart[:, :, :3] *= torch.tensor([-1.0, 1.0, -1.0])
    cameras = dataclasses.replace(STILL.cameras, camera_to_worlds=looking_apart)
    assert transient_share(dataclasses.replace(STILL, cameras=cameras)) is None


def test_thin_errors_do_not_count() -> None:
    mask = torch.zeros(12, 12, dtype=torch.bool)
    mask[:, 1:3] = mask[4:8, 6:10] = True
    expected = torch.zeros_like(mask)
    expected[4:8, 6:10] = True
    assert torch.equal(in_blocks(mask), expected)


@pytest.mark.parametrize("name", ["instant-ngp", "gaussian-splatting", "nerf-w"])
def test_a_scout_is_chosen_and_said_only_on_clear_evidence(name: str) -> None:
    method, crowd = load_method(name), covered(STILL, 12)
    settings, made = decided(method, method.config, crowd)[1:]
    assert settings.robust == ("off" if name == "nerf-w" else "scout")
    said = [decision.line() for decision in made if decision.option == "things that come and go"]
    assert len(said) == (name != "nerf-w")
    assert all("--robust scout" in line and "contradict 9% of a typical photograph" in line for line in said)
    if name == "nerf-w":  # it has a transient part of its own
        return
    assert decided(method, dataclasses.replace(method.config, robust="off"), crowd)[1].robust == "off"
    times = torch.linspace(0, 1, COUNT)
    moving = dataclasses.replace(crowd, times=times, scene=dataclasses.replace(crowd.scene, moving=True))
    for dataset, lines in ((STILL, 0), (moving, 0), (courtyard(turn=20.0), 1)):
        settings, made = decided(method, method.config, dataset)[1:]
        assert settings.robust == "off"
        assert sum("not looked for" in decision.line() for decision in made) == lines

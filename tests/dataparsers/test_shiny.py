"""Shiny scenes: blurred light against Monte Carlo, reflections by hand, and files as Shiny Blender has them."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from nerfloom.data.dataset import load_dataset
from nerfloom.dataparsers.blender import Blender
from nerfloom.dataparsers.procedural.environment import make_environment
from nerfloom.dataparsers.procedural.shiny import GOLD, MIRROR, SCENES, light_along, render_shiny, write_shiny
from nerfloom.dataparsers.procedural.solids import poses_around
from nerfloom.evaluation.true_outputs import mean_angle
from nerfloom.kernels.color import to_srgb
from tests.kernels.test_directional_encoding import drawn

LAMPS = make_environment(0)


@pytest.mark.parametrize("roughness", [1e-3, 0.03, 0.3])
def test_blurred_light_is_the_mean_of_sharp_light(roughness: float) -> None:
    """Over von Mises and Fisher's distribution, up to the approximation that a blurred lamp is a lamp."""
    means = normalize(torch.randn(6, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64), dim=-1)
    sharp, kappa = torch.zeros(1, dtype=torch.float64), 1 / roughness
    truth = torch.stack([LAMPS.light(drawn(mean, kappa, 40_000).T, sharp).mean(1) for mean in means])
    found = LAMPS.light(means.T, torch.full((6,), roughness, dtype=torch.float64)).T
    error = ((found - truth).abs() / truth).max().item()
    print(f"roughness {roughness:g}: light off by {error:.1e}")
    assert error < 0.1


def test_a_mirror_shows_the_environment() -> None:
    """The middle of the ball shows the environment behind the camera, and its edge the environment behind the ball."""
    (ball,) = SCENES["mirror"]
    origin = torch.tensor([[4.0, 0.0, 0.0]], dtype=torch.float64).T
    edge = math.asin(ball.shape.bound / 4) - 1e-9
    directions = torch.tensor([[-1.0, 0, 0], [-math.cos(edge), math.sin(edge), 0]], dtype=torch.float64).T
    found = light_along(origin, directions, (ball,), LAMPS)
    expected = LAMPS.light(torch.stack([-directions[:, 0], directions[:, 1]], 1), torch.zeros(2, dtype=torch.float64))
    reflected = torch.tensor([MIRROR.reflectance, (1.0, 1.0, 1.0)], dtype=torch.float64).T
    torch.testing.assert_close(found.specular, reflected * expected, atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(found.normals[:, 0], torch.tensor([1.0, 0, 0]).double())
    assert not found.diffuse.any()
    assert found.roughness.tolist() == [0, 0]


def test_rough_metal_has_its_roughness_and_no_diffuse_light() -> None:
    pose = poses_around(5)[2]
    _, _, light = render_shiny(pose, 24, SCENES["metal"], LAMPS)
    assert light is not None
    assert light.roughness[light.hit].unique().tolist() == [GOLD.roughness]
    assert not light.diffuse.any()
    assert bool((light.specular[:, light.hit] > 0).all())
    assert not light.specular[:, ~light.hit].any()


def test_display_colours_are_those_of_the_standard() -> None:
    """Values of IEC 61966-2-1; the gradient is finite at 0."""
    light = torch.tensor([0.0, 0.0031308, 0.2140411, 1.0], dtype=torch.float64, requires_grad=True)
    found = to_srgb(light)
    torch.testing.assert_close(found, torch.tensor([0.0, 0.04045, 0.5, 1.0]).double(), atol=1e-5, rtol=0)
    (slope,) = torch.autograd.grad(found.sum(), light)
    assert bool(slope.isfinite().all())


@pytest.fixture(scope="module")
def shiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of all scenes."""
    folder = tmp_path_factory.mktemp("shiny") / "shiny"
    write_shiny(folder, size=24, num_train=3, num_test=2)
    return folder


@pytest.mark.medium
def test_scenes_are_written_and_read_as_shiny_blenders(shiny: Path) -> None:
    """Normals beside images are not views; read back, they are the surface's within 8 bits."""
    assert {path.name for path in shiny.iterdir()} == set(SCENES)
    folder = shiny / "together"
    dataset = load_dataset(Blender().parse(folder, "test"), "test")
    assert dataset.names == ("r_000.png", "r_001.png")
    frames = json.loads((folder / "transforms_test.json").read_text())["frames"]
    known = np.load(folder / "test" / "r_001_light.npz")
    assert {name: known[name].shape for name in known} == {
        "diffuse": (24, 24, 3), "specular": (24, 24, 3), "roughness": (24, 24, 1),
    }  # fmt: skip
    _, _, light = render_shiny(np.array(frames[1]["transform_matrix"]), 24, SCENES["together"], LAMPS)
    assert light is not None
    diffuse = dataset.diffuse_of(1)
    assert diffuse is not None
    torch.testing.assert_close(diffuse.view(-1, 3), light.diffuse.T.float())
    assert load_dataset(Blender().parse(folder, "train"), "train").diffuse_of(0) is None
    normals, alpha = dataset.normals_of(1), dataset.image(1)[..., 3].flatten()
    assert normals is not None
    inside = (alpha == 255).float()
    assert inside.sum() > 20
    angle = mean_angle(normals.reshape(-1, 3), light.normals.T.float(), inside)
    assert angle is not None
    assert angle < 2  # a pixel's normal is the mean of nine


def test_normals_turn_with_a_scene_that_is_placed(shiny: Path, tmp_path: Path) -> None:
    """A folder without normals beside its images has none."""
    folder = shutil.copytree(shiny / "mirror", tmp_path / "mirror")
    parsed = Blender().parse(folder, "test")
    turn = torch.tensor([[0.0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 0]], dtype=torch.float64)
    found = [load_dataset(p, "test").normals_of(0) for p in (parsed, replace(parsed, transform=turn))]
    torch.testing.assert_close(found[0] @ turn[:, :3].float().T, found[1])
    for path in folder.glob("test/*_normal.png"):
        path.unlink()
    assert load_dataset(Blender().parse(folder, "test"), "test").normals_of(0) is None
    assert iio.imread(folder / "test" / "r_000.png").shape == (24, 24, 4)

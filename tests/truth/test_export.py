"""Exports of a run: refined cameras, and points where half of the light is gone."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.linalg import expm
from torch import Tensor

from nerfloom.dataparsers.polycam import Polycam
from nerfloom.export.points import SurfacePoints, joined, surface_points
from nerfloom.geometry.rays import Rays
from nerfloom.rendering.rendered import Rendered
from nerfloom.training.checkpoint import load_checkpoint
from nerfloom.training.datasets import load_split
from nerfloom.training.run import create_folder
from nerfloom.training.trainer import Trainer
from tests.training.helpers import tiny_run, tiny_trainer
from tests.truth.ball import CENTRE, COUNT, HELD_OUT, NAMES, RADIUS, pose_of, surface
from tests.truth.formats import write_polycam
from tests.truth.test_run import command, read_cloud

CHANNELS = ("red", "green", "blue")


def generator(vector: np.ndarray) -> np.ndarray:
    """(3, 3) the generator of a rotation vector."""
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


@pytest.fixture
def untrained(tmp_path: Path) -> Trainer:
    """A run of no step on the ball as a device has it, in another frame and unit than its scene."""
    still = tiny_run("nerfacto", write_polycam(tmp_path / "ball"), tmp_path / "run")
    run = replace(still, dataparser="polycam", parser=Polycam())
    create_folder(run)
    return Trainer.of(run, load_split(run, "train"))


def test_a_checkpoint_tells_where_its_scene_lies_in_the_captures_frame(untrained: Trainer) -> None:
    """Its transform and scale, which start every export, put cameras where photographs were taken."""
    content = load_checkpoint(untrained.save())
    transform, scale = np.array(content["transform"]), content["scale"]
    places = untrained.train_set.cameras.camera_to_worlds[:, :, 3].double().numpy()
    found = (places / scale - transform[:, 3]) @ transform[:, :3]
    truth = np.stack([pose_of(NAMES.index(name))[:3, 3] for name in untrained.train_set.names])
    np.testing.assert_allclose(found, truth, atol=1e-5)
    assert abs(scale - 1) > 0.1


def test_refined_cameras_are_exported_where_they_are_believed_to_be(untrained: Trainer, tmp_path: Path) -> None:
    """They are in the device's frame and metres, each with the motion in the scene that was learnt for it."""
    tangents = 0.1 * torch.randn(COUNT - len(HELD_OUT), 6, generator=torch.Generator().manual_seed(0))
    untrained.model.load_state_dict({"poses.tangents": tangents}, strict=False)
    untrained.save()
    command("ns-export", "cameras", "--load-config", tmp_path / "run" / "config.yml", "--output-dir", tmp_path)
    listed = json.loads((tmp_path / "transforms_train.json").read_text())
    placed, scale = untrained.train_set.transform.double().numpy()[:, :3], untrained.train_set.scale
    for row, tangent in zip(listed, tangents.double().numpy(), strict=True):
        given = pose_of(NAMES.index(row["file_path"]))
        found = np.array(row["transform"])
        turn = placed.T @ expm(generator(tangent[3:])) @ placed
        np.testing.assert_allclose(found[:, :3], turn @ given[:3, :3], atol=1e-5)
        np.testing.assert_allclose(found[:, 3], given[:3, 3] + placed.T @ tangent[:3] / scale, atol=1e-5)


def test_exported_points_normals_and_colours_are_in_the_captures_frame(
    untrained: Trainer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run finds the ball, in its scene's frame and unit: a point is its normal times the radius away."""
    truth = surface(50)
    normals = (truth - CENTRE) / RADIUS
    transform, scale = untrained.train_set.transform.double().numpy(), untrained.train_set.scale
    in_scene = scale * (truth @ transform[:, :3].T + transform[:, 3])
    as_tensors = [torch.from_numpy(x).float() for x in (in_scene, 0.5 + 0.4 * normals, normals @ transform[:, :3].T)]
    found = SurfacePoints(*as_tensors, -as_tensors[2], torch.arange(50))
    monkeypatch.setattr("nerfloom.export.point_cloud.surface_points", lambda *_: iter([found]))
    untrained.save()
    command(
        "ns-export", "pointcloud", "--load-config", tmp_path / "run" / "config.yml", "--output-dir", tmp_path,
        "--remove-outliers", False, "--estimate-normals", False,
    )  # fmt: skip
    cloud = read_cloud(tmp_path / "point_cloud.ply")
    columns = [[cloud[name].astype(float) for name in names] for names in ("xyz", ("nx", "ny", "nz"), CHANNELS)]
    positions, directions, colors = (np.stack(column, -1) for column in columns)
    np.testing.assert_allclose(positions, truth, atol=1e-5)
    np.testing.assert_allclose(directions, normals, atol=1e-5)
    np.testing.assert_allclose(colors / 255, 0.5 + 0.4 * normals, atol=0.51 / 255)


@pytest.mark.parametrize("reach", [None, 0.5])
def test_points_are_where_half_of_the_light_is_gone_and_within_reach_of_the_box(
    reach: float | None, shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The picture is given: median and mean depth differ, the box is not around the origin, normals and colours belong
    to their points."""
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run")
    model = trainer.model.eval()
    middle, half = torch.tensor([0.3, -0.2, 0.4]), torch.tensor([1.0, 0.8, 1.2])
    model.scene = replace(model.scene, box=torch.stack([middle - half, middle + half]))

    def render(rays: Rays, background: Tensor) -> Rendered:
        count = torch.arange(len(rays))
        depth = 3.0 + 2 * (count % 7) / 7
        places = rays.origins + depth[:, None] * rays.directions
        accumulation = torch.where(count % 5 == 0, 0.4, 1.0)
        half, normals = torch.full_like(depth, 0.5), {"normals": places}
        return Rendered(places.sin().abs(), half, depth, accumulation, 0, extras=normals)

    monkeypatch.setattr(model, "render", render)
    found: Any = joined(surface_points(model, trainer.train_set, 3000, reach))
    torch.testing.assert_close(found.colors, found.positions.sin().abs())
    torch.testing.assert_close(found.normals, torch.nn.functional.normalize(found.positions, dim=-1))
    inside = ((found.positions - middle).abs() <= (reach or 1e9) * half).all(-1)
    assert bool(inside.all())
    if reach is None:
        assert len(found.positions) == 4 * 3000 // 5
    else:
        # All points there, of rays that all go on for 3 to 5 from cameras at 4 from the origin.
        every = joined(surface_points(model, trainer.train_set, 3000, None)).positions
        share = ((every - middle).abs() <= reach * half).all(-1).double().mean()
        assert len(found.positions) / (4 * 3000 / 5) == pytest.approx(float(share), abs=0.04)
        assert share > 0.05

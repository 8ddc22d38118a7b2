"""Exports of what a run has made of its input: refined cameras, and points that are where half of the light is gone."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.linalg import expm
from torch import Tensor

from dataparsers.polycam import Polycam
from framework.export.points import joined, surface_points
from framework.geometry.rays import Rays
from framework.rendering.volume import Rendered
from framework.training.checkpoint import FOLDER, load_checkpoint, load_newest
from framework.training.datasets import load_split
from framework.training.run import create_folder
from framework.training.trainer import Trainer
from tests.training.helpers import tiny_run, tiny_trainer
from tests.truth.ball import COUNT, HELD_OUT, NAMES, pose_of
from tests.truth.formats import write_polycam
from tests.truth.test_run import command

TINY = (
    "--num-levels", 3, "--max-resolution", 32, "--log2-table-size", 10, "--num-proposal-samples", 12,
    "--num-nerf-samples", 8, "--num-rays-per-batch", 128, "--max-num-iterations", 6, "--max-eval-images", 0,
    "--camera-learning-rate", 0.01, "--vis", "none",
)  # fmt: skip


def generator(vector: np.ndarray) -> np.ndarray:
    """(3, 3) what a rotation vector is the exponential of."""
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


@pytest.mark.medium
def test_refined_cameras_are_exported_where_they_are_believed_to_be(tmp_path: Path) -> None:
    """A device's poses, in its own frame and metres, each with the motion that the run has learnt for it."""
    data = write_polycam(tmp_path / "ball")
    command("ns-train", "nerfacto", "--data", data, "--output-dir", tmp_path, "--timestamp", "t", *TINY)
    run = tmp_path / "ball" / "nerfacto" / "t"
    command("ns-export", "cameras", "--load-config", run / "config.yml", "--output-dir", tmp_path)
    listed = json.loads((tmp_path / "transforms_train.json").read_text())
    content = load_newest(run / FOLDER)
    assert content is not None
    placed, scale = content["transform"].double().numpy()[:, :3], content["scale"]
    tangents = content["model"]["poses.tangents"].double().numpy()
    assert np.abs(tangents).min() > 1e-3
    assert len(listed) == len(tangents) == COUNT - len(HELD_OUT)
    for row, tangent in zip(listed, tangents, strict=True):
        given = pose_of(NAMES.index(row["file_path"]))
        found = np.array(row["transform"])
        turn = placed.T @ expm(generator(tangent[3:])) @ placed
        np.testing.assert_allclose(found[:, :3], turn @ given[:3, :3], atol=1e-5)
        np.testing.assert_allclose(found[:, 3], given[:3, 3] + placed.T @ tangent[:3] / scale, atol=1e-5)


def test_a_checkpoint_tells_where_its_scene_lies_in_the_captures_frame(tmp_path: Path) -> None:
    """By its transform and scale, with which every export begins, the cameras stand where the photographs were taken."""
    still = tiny_run("instant-ngp", write_polycam(tmp_path / "ball"), tmp_path / "run")
    run = replace(still, dataparser="polycam", parser=Polycam())
    create_folder(run)
    trainer = Trainer(run, load_split(run, "train"), None)
    content = load_checkpoint(trainer.save())
    transform, scale = content["transform"].double().numpy(), content["scale"]
    places = trainer.train_set.cameras.camera_to_worlds[:, :, 3].double().numpy()
    found = (places / scale - transform[:, 3]) @ transform[:, :3]
    truth = np.stack([pose_of(NAMES.index(name))[:3, 3] for name in trainer.train_set.names])
    np.testing.assert_allclose(found, truth, atol=1e-5)
    assert abs(scale - 1) > 0.1


@pytest.mark.parametrize("reach", [None, 0.5])
def test_points_are_where_half_of_the_light_is_gone_and_within_reach_of_the_box(
    reach: float | None, shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a picture that is told: median and mean depth apart, a box that is not around the origin, normals and colours
    that go with their points."""
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run")
    model = trainer.model.eval()
    middle, half = torch.tensor([0.3, -0.2, 0.4]), torch.tensor([1.0, 0.8, 1.2])
    model.scene = replace(model.scene, box=torch.stack([middle - half, middle + half]))

    def render(rays: Rays, background: Tensor) -> Rendered:
        count = torch.arange(len(rays))
        depth = 3.0 + 2 * (count % 7) / 7
        places = rays.origins + depth[:, None] * rays.directions
        accumulation = torch.where(count % 5 == 0, 0.4, 1.0)
        return Rendered(places.sin().abs(), torch.full_like(depth, 0.5), depth, accumulation, 0, normals=places)

    monkeypatch.setattr(model, "render", render)
    found: Any = joined(surface_points(model, trainer.train_set, 3000, reach))
    torch.testing.assert_close(found.colors, found.positions.sin().abs())
    torch.testing.assert_close(found.normals, torch.nn.functional.normalize(found.positions, dim=-1))
    inside = ((found.positions - middle).abs() <= (reach or 1e9) * half).all(-1)
    assert bool(inside.all())
    if reach is None:
        assert len(found.positions) == 4 * 3000 // 5
    else:
        # As many as lie there, of rays that all go on for 3 to 5 from cameras at 4 from the origin.
        every = joined(surface_points(model, trainer.train_set, 3000, None)).positions
        share = ((every - middle).abs() <= reach * half).all(-1).double().mean()
        assert len(found.positions) / (4 * 3000 / 5) == pytest.approx(float(share), abs=0.04)
        assert share > 0.05

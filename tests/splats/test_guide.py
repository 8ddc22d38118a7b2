"""Distances that a field has found: the pixels that have them, when they count, and their effect on Gaussians."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from nerfloom.cameras.refinement import PoseRefinement
from nerfloom.cameras.view import View
from nerfloom.data.pixels.batch import ViewBatch
from nerfloom.export.points import SurfacePoints
from nerfloom.export.surfaces import found_surfaces
from nerfloom.methods.gaussian_splatting import GaussianSplattingConfig, decide
from nerfloom.registry import load_method
from nerfloom.splats.guide import GUIDED_UNTIL, FoundDistances, guidance
from nerfloom.testing.scenes import ball_in_a_box
from tests.splats.test_method import SCENE, ball, camera
from tests.splats.test_what_images_differ_in import model_of
from tests.training.helpers import TINY, tiny_trainer


def some() -> FoundDistances:
    """Two pixels of image 0, one of image 2."""
    found = FoundDistances()
    found.set(torch.tensor([0, 2, 0]), torch.tensor([0, 5, 7]), torch.tensor([1.0, 2.0, 3.0]))
    return found


def batch(index: int, distances: torch.Tensor | None = None) -> ViewBatch:
    """An image of 3 x 4 pixels."""
    return ViewBatch(index, View(camera(), None), torch.zeros(3, 4, 3), torch.zeros(3), distances=distances)


def test_pixels_are_counted_row_by_row_in_their_image() -> None:
    expected = torch.zeros(3, 4)
    expected[0, 0], expected[1, 3] = 1, 3
    assert torch.equal(some().of_image(0, 3, 4), expected)
    assert some().of_image(1, 3, 4).count_nonzero() == 0
    assert float(some().of_image(2, 3, 4)[1, 1]) == 2


def test_guidance_fades_until_it_ends() -> None:
    assert guidance(0.0) == 1
    assert guidance(GUIDED_UNTIL / 2) == pytest.approx(0.5)
    assert guidance(GUIDED_UNTIL) == guidance(1.0) == 0


def test_measured_distances_come_first() -> None:
    measured = torch.full((3, 4), 9.0)
    known, weight = some().known(batch(0, measured), 0.0, 0.3, 0.1)
    assert known is measured
    assert weight == 0.3
    known, weight = some().known(batch(0, measured), 0.0, 0.0, 0.1)
    assert known is not None
    assert torch.equal(known, some().of_image(0, 3, 4))
    assert weight == 0.1
    assert some().known(batch(0), 1.0, 0.3, 0.1) == (None, 0.0)
    assert FoundDistances().known(batch(0), 0.0, 0.3, 0.1) == (None, 0.0)


def test_a_checkpoint_has_as_many_as_it_has() -> None:
    found = FoundDistances()
    found.load_state_dict(some().state_dict())
    assert torch.equal(found.of_image(0, 3, 4), some().of_image(0, 3, 4))
    found.load_state_dict({})  # from before there were such distances
    assert len(found) == 3


def test_what_a_field_finds_lies_on_the_rays_of_its_pixels(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("gaussian-splatting", shared_tiny, tmp_path, start="random", num_gaussians=100)
    dataset = trainer.train_set
    found = found_surfaces(load_method("instant-ngp"), dataset, trainer.config, 10, 60.0, 500)
    assert len(found.positions) > 100
    cameras = dataset.cameras
    rays = cameras.pixel_rays(cameras.offsets[found.images] + found.pixels, 0.0, 1.0)
    places = rays.origins + found.distances[:, None] * rays.directions
    assert torch.allclose(places, found.positions, atol=1e-4)
    assert found.motions is None


@pytest.mark.parametrize(("robust", "expected"), [("off", "off"), ("scout", "off"), ("errors", "errors")])
def test_the_field_has_the_rule_of_the_gaussians_and_no_scout_of_its_own(
    robust: str, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its own auto would look for people again, also with --robust off."""
    config: Any = load_method("gaussian-splatting").config

    def trainer(method: Any, settings: Any, dataset: Any) -> None:
        assert settings.robust == expected
        raise InterruptedError

    monkeypatch.setattr("nerfloom.export.surfaces.Trainer", trainer)
    with pytest.raises(InterruptedError):
        found_surfaces(load_method("instant-ngp"), ball_in_a_box(8), replace(config, robust=robust), 10, 60.0, 500)


@pytest.mark.parametrize(("end_on_a_surface", "most"), [(1, 300), (4, 1200)])
def test_no_more_rays_are_drawn_than_points_are_missing(
    end_on_a_surface: int, most: int, shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If one of n rays ends on a surface, n rays give a point."""
    drawn: list[int] = []

    def shown(model: Any, dataset: Any, count: int, reach: float | None) -> Iterator[SurfacePoints]:
        drawn.append(count)
        places = torch.rand(-(-count // end_on_a_surface), 3)
        yield SurfacePoints(places, places, None, places, torch.zeros(len(places), dtype=torch.long))

    monkeypatch.setattr("nerfloom.export.points.surface_points", shown)
    trainer = tiny_trainer("gaussian-splatting", shared_tiny, tmp_path, start="random", num_gaussians=100)
    found = found_surfaces(load_method("instant-ngp"), trainer.train_set, trainer.config, 2, 60.0, 300)
    assert len(found.positions) == 300
    assert sum(drawn) <= most


def test_what_a_field_finds_lies_on_the_rays_of_the_cameras_that_it_has_moved(
    shared_tiny: Path, tmp_path: Path
) -> None:
    """Not on the rays of the given ones: Gaussians that start there need the motions too."""
    trainer = tiny_trainer("gaussian-splatting", shared_tiny, tmp_path, start="random", num_gaussians=100)
    dataset, nerfacto = trainer.train_set, load_method("nerfacto")
    settings: dict[str, Any] = {**TINY["nerfacto"], "camera_optimizer": "SE3", "camera_learning_rate": 0.1}
    field = replace(nerfacto, config=replace(nerfacto.config, **settings))
    found = found_surfaces(field, dataset, trainer.config, 20, 60.0, 200)
    assert len(found.positions) > 0
    assert found.motions is not None
    refinement = PoseRefinement(len(dataset), "SE3")
    refinement.tangents.data.copy_(found.motions)
    given = dataset.cameras
    moved = replace(given, camera_to_worlds=refinement.refined(given.camera_to_worlds, training=True))
    apart = []
    for cameras in (moved, given):
        rays = cameras.pixel_rays(cameras.offsets[found.images] + found.pixels, 0.0, 1.0)
        places = rays.origins + found.distances[:, None] * rays.directions
        apart.append(float((places - found.positions).norm(dim=-1).max()))
    print(f"points off the rays of moved cameras by {apart[0]:.1e}, of given ones by {apart[1]:.1e}")
    assert apart[0] < 3e-4
    assert apart[1] > 10 * apart[0]


def test_gaussians_are_pulled_to_the_distances_of_a_field_until_it_fades() -> None:
    """One Gaussian at distance 3, which a field has found at 2.5: the loss is the relative error, times its weight."""
    one = camera()
    model = model_of(ball(), one, field_depth_mult=0.5)
    model.found_distances.set(torch.tensor([0]), torch.tensor([16 * 33 + 16]), torch.tensor([2.5]))
    drawn = ViewBatch(0, View(one), torch.rand(33, 33, 3), torch.zeros(3))
    model.progress = GUIDED_UNTIL / 2
    term = model.loss(drawn, 0).terms["depth"]
    assert float(term.detach()) == pytest.approx(0.5 * 0.5 * 0.2, abs=3e-4)
    term.backward()
    assert model.columns["means"].values.grad is not None
    assert float(model.columns["means"].values.grad[0, 2]) < 0  # the camera is at z = 3, and looks down
    model.progress = GUIDED_UNTIL
    assert "depth" not in model.loss(drawn, 0).terms


def test_captures_are_guided() -> None:
    for unbounded in (True, False):
        config, made = decide(GaussianSplattingConfig(), replace(SCENE, unbounded=unbounded))
        assert config.field_depth_mult == (0.1 if unbounded else 0.0)
        assert [one for one in made if one.option == "weight of a field's distances"]

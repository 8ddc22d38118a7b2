"""A method of Gaussians that is nothing but a start and a loss."""

import dataclasses
import itertools
from typing import Any

import pytest
import torch

from nerfloom import Dataset, GaussianModel, Loss, Method, Scene, ViewBatch
from nerfloom.base.pace import Pace
from nerfloom.splats.density_control import DensityControl
from nerfloom.splats.drawing import splat_camera
from nerfloom.splats.learning import MAX_MOVES, MAX_STEPS, MIN_STEPS, steps_per_move
from nerfloom.splats.mcmc import Mcmc
from nerfloom.splats.settings import SplattingConfig, decide_splatting
from nerfloom.splats.start import first_points, from_points, seen_colors
from nerfloom.testing import check_method


class Plain(GaussianModel[SplattingConfig]):
    """Gaussians that start anywhere and learn the absolute error."""

    def start(self, dataset: Dataset) -> None:
        points = first_points("random", dataset, self.config.start_gaussians or 1)
        self.set_gaussians(from_points(points, seen_colors(points, dataset), self.config.degree))

    def loss(self, batch: ViewBatch, step: int) -> Loss:
        camera = splat_camera(batch.view.camera, self.near, self.look())
        shown = self.on_image(self.learnt_gaussians(), camera, self.config.degree)
        rgb = self.rasteriser.draw(shown, camera, batch.background, capacity=self.capacity).image
        return Loss({"rgb": (rgb - batch.rgb).abs().mean()}, rgb.detach())


METHOD = Method(SplattingConfig(), paper="", model=Plain, decide=decide_splatting)
SCENE = Scene(torch.tensor([[-1.0] * 3, [1.0] * 3]), 1.0, 6.0, 4, True, False, 32, image_pixels=400 * 400)
FEW: dict[str, Any] = {"num_gaussians": 600, "start_gaussians": 400, "steps_per_move": 10}


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["adc", "mcmc", "relocation"])
def test_a_start_and_a_loss_are_a_method(strategy: str) -> None:
    torch.manual_seed(0)
    findings = check_method(METHOD, "plain", dataclasses.replace(METHOD.config, strategy=strategy, **FEW))
    assert [finding.line() for finding in findings if not finding.ok] == []
    assert len(findings) > 10


def test_there_are_enough_changes_to_reach_the_maximum() -> None:
    for changes in (DensityControl.changes_per_doubling, Mcmc.changes_per_doubling):
        once = steps_per_move(300.0, 30_000, 60_000, changes)
        assert once == pytest.approx(300 / min(changes, MAX_MOVES), abs=1)
        assert 300 / steps_per_move(300.0, 100, 60_000, changes) == pytest.approx(300 / MIN_STEPS)
        assert steps_per_move(1_000.0, 100, 60_000, changes) == 1_000 // MAX_MOVES
    assert steps_per_move(500.0, 60_000, 60_000, DensityControl.changes_per_doubling) == MAX_STEPS
    assert steps_per_move(0.0, 10, 60_000, DensityControl.changes_per_doubling) == MIN_STEPS


@pytest.mark.parametrize(("given", "expected"), [({}, MIN_STEPS), ({"steps_per_move": 40}, 40)])
def test_a_slow_run_changes_the_number_more_often(given: dict[str, Any], expected: int) -> None:
    """A second a step leaves 50 steps: far too few for changes each 100 steps, for any expectation."""
    config, _ = decide_splatting(SplattingConfig(max_seconds=60.0, start_gaussians=100, **given), SCENE)
    model = Plain(config, SCENE)
    assert model.steps_per_move == given.get("steps_per_move", MAX_STEPS)
    for step in range(4):
        model.keep_pace(Pace(step, float(step), 60.0))
        model.before_step(step, step / 60)
    assert model.steps_per_move == expected


def test_changes_are_as_far_apart_as_was_asked_when_that_varies() -> None:
    """Measured times vary, and with them the steps between changes. Multiples of a varying number would be anywhere."""
    config, _ = decide_splatting(SplattingConfig(max_seconds=60.0, start_gaussians=100), SCENE)
    model, changed = Plain(config, SCENE), []
    for step in range(2000):
        model.steps_per_move = 58 + step % 5
        if model.changes_rows(step, 0.5):
            assert list(model.after_step(step, 0.5)) == []  # nothing wants to grow
            changed.append(step)
    apart = [second - first for first, second in itertools.pairwise(changed)]
    assert len(apart) > 30
    assert set(apart) <= set(range(58, 63))


def test_a_run_that_goes_on_changes_at_the_same_steps() -> None:
    config, _ = decide_splatting(
        SplattingConfig(max_num_iterations=1000, steps_per_move=10, start_gaussians=100), SCENE
    )

    def changes(first: int) -> list[int]:
        model, changed = Plain(config, SCENE), []
        for step in range(first, 60):
            if model.changes_rows(step, step / 1000):
                model.after_step(step, step / 1000)
                changed.append(step)
        return changed

    assert changes(0) == [9, 19, 29, 39, 49, 59]
    assert changes(30) == [39, 49, 59]
    assert changes(39) == [39, 49, 59]

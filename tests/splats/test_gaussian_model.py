"""A method of Gaussians that is nothing but a start and a loss."""

import dataclasses
from typing import Any

import pytest
import torch

from framework import Dataset, GaussianModel, Loss, Method, ViewBatch
from framework.splats.drawing import draw, splat_camera
from framework.splats.settings import SplattingConfig, decide_splatting
from framework.splats.start import first_points, from_points, seen_colors
from framework.tools.testing import check_method


class Plain(GaussianModel[SplattingConfig]):
    """Gaussians that start anywhere and learn the absolute error."""

    def start(self, dataset: Dataset) -> None:
        points = first_points("random", dataset, self.config.start_gaussians or 1)
        self.set_gaussians(from_points(points, seen_colors(points, dataset), self.config.degree))

    def loss(self, batch: ViewBatch, step: int) -> Loss:
        camera = splat_camera(batch.view.camera, self.near, self.look())
        records = self.on_image(self.learnt_gaussians(), camera, self.config.degree)
        rgb = draw(records, camera, batch.background, room=self.room).image
        return Loss({"rgb": (rgb - batch.rgb).abs().mean()}, rgb.detach())


METHOD = Method(SplattingConfig(), paper="", model=Plain, decide=decide_splatting)
FEW: dict[str, Any] = {"num_gaussians": 600, "start_gaussians": 400, "steps_per_move": 10}


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["adc", "mcmc"])
def test_a_start_and_a_loss_are_a_method(strategy: str) -> None:
    torch.manual_seed(0)
    findings = check_method(METHOD, "plain", dataclasses.replace(METHOD.config, strategy=strategy, **FEW))
    assert [finding.line() for finding in findings if not finding.ok] == []
    assert len(findings) > 10

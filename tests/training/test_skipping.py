"""Each kind of skipping is reported, can be switched off, and changes renders within its stated bound."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from nerfloom.splats.start import from_points
from nerfloom.training.skipping import Rung, lines, skip_report
from tests.conftest import write_tiny
from tests.training.helpers import assert_same_bits, tensors, tiny_trainer


@pytest.mark.medium
def test_the_report_tells_what_was_skipped(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=60)
    trainer.train()
    before = tensors(trainer)
    rungs = {rung.name: rung for rung in skip_report(trainer)}
    assert_same_bits(before, tensors(trainer))  # looking changes nothing
    assert len(rungs) == 6
    assert all(0 <= rung.skipped <= 1 for rung in rungs.values())
    sampler = trainer.model.sampler
    occupied = float(sampler.occupied.float().mean())
    assert rungs["cells, empty"].skipped == pytest.approx(1 - occupied)
    assert rungs["cells, outside the visual hull"].skipped == pytest.approx(sampler.carved.float().mean().item())
    assert rungs["steps along a ray, in empty cells"].skipped > 0.1
    said = "\n".join(lines(list(rungs.values())))
    assert f"empty space: {1 - occupied:.0%} of the box is never sampled" in said
    share = rungs["steps along a ray, in empty cells"].skipped
    assert f"empty space along rays: {share:.0%} of samples, " in said
    assert all(rung.switch not in said and rung.name not in said for rung in rungs.values())


def test_rays_without_room_are_told(shared_tiny: Path, tmp_path: Path) -> None:
    """Off the CPU, where samples have a fixed number of slots."""
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run")
    trainer.model.sampler.capacity.rays, trainer.model.sampler.capacity.left_out = 4000, 100
    (rung,) = (rung for rung in skip_report(trainer) if "buffer full" in rung.name)
    assert rung.skipped == 0.025
    assert "the sample buffer was full: 2.5%" in "\n".join(lines([rung]))


def test_gaussians_that_images_do_not_show_are_told(tmp_path: Path) -> None:
    """Small ones all around the cameras: those with a centre in an image are shown, and others hardly beyond it."""
    trainer = tiny_trainer("gaussian-splatting", write_tiny(tmp_path / "ball", 64), tmp_path / "run")
    torch.manual_seed(0)
    points = 10 * torch.rand(2000, 3) - 5
    small = from_points(points, torch.full_like(points, 0.5), trainer.model.config.degree, opacity=0.9, size=0.01)
    trainer.model.set_gaussians(small)
    (rung,) = (rung for rung in skip_report(trainer) if rung.name == "Gaussians, not in an image")

    def share_within(margin: float) -> float:
        shares = []
        for index in (0, 3, 6, 9):
            columns, rows, ahead = trainer.train_set.cameras.project(points, index)
            across, down = (at.clamp(-0.5 - margin, 63.5 + margin) == at for at in (columns, rows))
            shares.append((across & down & ahead).float().mean().item())
        return sum(shares) / 4

    print(rung.skipped, 1 - share_within(4), 1 - share_within(0))
    assert 1 - share_within(4) <= rung.skipped <= 1 - share_within(0)
    assert 0.5 < rung.skipped < 0.99
    assert f"Gaussians that an image does not show: {rung.skipped:.0%}, " in "\n".join(lines([rung]))


def test_what_saved_nothing_is_not_told() -> None:
    nothing = Rung("cells", 0.001, None, "--off", "empty space: 0% of the box")
    assert lines([nothing]) == []
    assert lines([nothing, replace(nothing, skipped=0.5, says="half of it")]) == ["left out:", "  half of it"]


def test_every_switch_switches(shared_tiny: Path, tmp_path: Path) -> None:
    off = {"silhouette_cells": False, "sparse_updates": False}
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=10, **off)
    trainer.train()
    assert not bool(trainer.model.sampler.carved.any())
    assert trainer.train_set.drawn is None
    assert {rung.name for rung in skip_report(trainer)} == {
        "steps along a ray, in empty cells",
        "the samples left, hidden",
        "cells, empty",
    }


def test_pixels_that_are_not_drawn_see_cells_alone_that_are_empty(tmp_path: Path) -> None:
    """Along their rays, step by step, no cell is left, and opaque pixels are drawn."""
    data = write_tiny(tmp_path / "ball", 64)
    trainer = tiny_trainer("instant-ngp", data, tmp_path / "run", grid_resolution=64)
    trainer.prepare()
    dataset, sampler, drawn = trainer.train_set, trainer.model.sampler, trainer.train_set.drawn
    assert drawn is not None
    left = torch.ones(len(dataset.pixels), dtype=torch.bool)
    left[drawn.pixels()] = False
    assert not bool((left & (dataset.pixels[:, 3] == 255)).any())
    assert 0.01 < float(left.float().mean()) < 0.5
    rays = dataset.cameras.pixel_rays(left.nonzero().squeeze(-1), 2.0, 6.0)
    points = rays.origins[:, None] + torch.linspace(2, 6, 800)[:, None] * rays.directions[:, None]
    unit = (points - sampler.box[0]) / (sampler.box[1] - sampler.box[0])
    inside = ((unit >= 0) & (unit < 1)).all(-1)
    cells = (unit[inside] * 64).long()
    assert len(cells) > 1000
    assert bool(sampler.carved[(cells[:, 0] * 64 + cells[:, 1]) * 64 + cells[:, 2]].all())


def test_methods_that_skip_nothing_report_nothing(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("vanilla-nerf", shared_tiny, tmp_path / "run", max_num_iterations=2)
    trainer.train()
    assert skip_report(trainer) == []


def test_carved_cells_stay_empty(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=80)
    trainer.train()
    sampler = trainer.model.sampler
    carved = sampler.carved.clone()
    assert 0 < carved.float().mean() < 1
    assert not bool((sampler.occupied & carved).any())
    torch.manual_seed(0)
    for step in (96, 128, 512, 528):
        sampler.update(
            step, lambda points: (torch.full((len(points),), 1e3), points.positions)
        )  # a field that is opaque everywhere
    assert not bool((sampler.occupied & carved).any())
    assert bool(sampler.occupied.any())

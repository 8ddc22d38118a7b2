"""Every method trains and renders on another device than the CPU, and learns the same there."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch

from nerfloom.data.dataset import Dataset
from nerfloom.evaluation.evaluator import measure_view
from nerfloom.training.trainer import Trainer
from tests.other_device import OTHER, There, other_device
from tests.training.test_graphs import COVERED, VARIANTS, small

STRIDE = 16
"""Interval of the compared rows and columns of a picture."""


def bent(dataset: Dataset) -> Dataset:
    """The data set as if its lenses bent straight lines."""
    lens = torch.tensor([0.05, -0.02, 1e-3, -1e-3, 0, 0, 0, 0, 0]).expand(len(dataset.cameras), 9)
    return dataclasses.replace(dataset, cameras=dataclasses.replace(dataset.cameras, model="opencv", lens=lens))


CASES: dict[str, dict[str, Any]] = {
    **VARIANTS,
    "marched": {"method": "instant-ngp"},
    "planes": {"method": "kplanes"},
    "marched voxels": {"method": "tensorf"},
    "moving": {"method": "dnerf", "canonical": "hash-grid"},
    "Gaussians": {"method": "gaussian-splatting"},
    # The first ball has slope 1, so the gradient of the eikonal term is rounding alone, which Adam scales up. The
    # curvature term is of every 32nd slot, and which samples these have differs between the devices.
    "surface": {"method": "neus", "thin_gradients": 0.0, "eikonal_loss_mult": 0.0, "curvature_loss_mult": 0.0},
    "surface by a density": {"method": "volsdf", "thin_gradients": 0.0, "curvature_loss_mult": 0.0},
    "nested boxes": {"sampler": "occupancy"},
    "few images": {"open_levels_until": 0.5, "occlusion_loss_mult": 0.01},
}


@pytest.mark.medium
@pytest.mark.parametrize("case", [pytest.param(c, marks=pytest.mark.slow) if c in COVERED else c for c in CASES])
def test_every_method_trains_and_renders_there(case: str, tmp_path: Path) -> None:
    here = small(tmp_path, **CASES[case])
    with other_device():
        there = Trainer(here.method, here.config, here.train_set.to(OTHER))
        first, losses = there.train_step().losses, there.train_step().losses
        assert isinstance(next(there.model.parameters()), There)
        picture = measure_view(there.model, there.train_set, 0, there.model.background, STRIDE)
    assert first == pytest.approx(here.train_step().losses, rel=1e-3, abs=1e-6)
    expected = here.train_step().losses
    assert losses.keys() == expected.keys()
    assert losses["rgb"] == pytest.approx(expected["rgb"], rel=5e-3)  # gradients are thinned at random
    same = measure_view(here.model, here.train_set, 0, here.model.background, STRIDE)
    assert picture.psnr == pytest.approx(same.psnr, abs=0.05)


def test_tensors_of_two_devices_are_refused() -> None:
    """The tests above can fail."""
    with other_device(), pytest.raises(RuntimeError, match="two devices"):
        torch.ones(3, device=OTHER) + torch.ones(3)


def test_steps_of_captures_with_bent_lenses_do_not_wait(tmp_path: Path) -> None:
    """A recording of them would fail: how often a lens's inverse is improved is found out before."""
    here = small(tmp_path)
    with other_device() as mode:
        trainer = Trainer(here.method, here.config, bent(here.train_set).to(OTHER))
        for _ in range(2):
            trainer.train_step()
        mode.waits.clear()
        trainer.train_step()
        assert not mode.waits
        float(torch.ones((), device=OTHER))
        assert mode.waits.total() == 1

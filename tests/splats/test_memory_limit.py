"""Training with a memory limit: a step changes Gaussians that its image may show, as without a limit, and no others."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch

from nerfloom import ConfigError, View
from nerfloom.base.machine_config import MachineConfig
from nerfloom.data.pixels.batch import ViewBatch
from nerfloom.gaussian_model import check_limit
from nerfloom.kernels.mapped_tables import MappedTables
from nerfloom.methods.gaussian_splatting import GaussianSplatting, GaussianSplattingConfig, decide
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.rasteriser import along_curve
from nerfloom.training.checkpoint import load_checkpoint
from nerfloom.training.optim import Adam, make_optimizer
from nerfloom.training.step import backward
from nerfloom.training.trainer import Trainer
from tests.kernels.compiled import needs_kernels
from tests.levels.made import cloud
from tests.splats.test_method import SCENE, camera
from tests.training.helpers import tiny_trainer

NEAR = 100
"""Gaussians in front of the camera; as many are behind it."""
CHUNK = 10
CPU = MachineConfig(device_type="cpu")


def two_groups() -> Gaussians:
    given = cloud(2 * NEAR, degree=3)
    given.means.mul_(0.3)
    given.means[NEAR:, 2] += 20
    return given


def built(folder: Path, **settings: Any) -> GaussianSplatting:
    given = GaussianSplattingConfig(opacity_penalty=0.1, scale_penalty=0.1, flatness_penalty=0.1, **settings)
    config, _ = decide(dataclasses.replace(given, cache_dir=folder, machine=CPU), SCENE)
    model = GaussianSplatting(config, SCENE)
    if model.rows_in_view is not None:
        model.rows_in_view.chunk = CHUNK
    model.set_gaussians(two_groups())
    return model


def trained(model: GaussianSplatting, steps: int = 3) -> Adam:
    optimizer = make_optimizer(model, model.config)
    target = torch.rand(33, 33, 3, generator=torch.Generator().manual_seed(0))
    for step in range(steps):
        model.before_step(step, 0.9)  # all harmonics are in use
        loss = model.loss(ViewBatch(0, View(camera()), target, torch.zeros(3)), step)
        assert backward(loss.total, optimizer)
        optimizer.step()
    return optimizer


@needs_kernels
def test_a_step_is_that_without_a_limit_for_what_it_may_show_and_leaves_the_rest_alone(tmp_path: Path) -> None:
    """Penalties count, too: their gradient of a Gaussian is the same, however many others are in view."""
    limited, free = built(tmp_path, memory_limit=50.0), built(tmp_path)
    assert isinstance(limited.tables, MappedTables)
    order = along_curve(two_groups().means)
    near = order < NEAR
    first = {name: column.values.detach().clone() for name, column in limited.columns.items()}
    optimizers = trained(limited), trained(free)
    assert limited.seen is not None
    assert torch.equal(limited.seen.indices, near.nonzero()[:, 0])
    for name, column in limited.columns.items():
        found, expected = column.values.detach(), free.columns[name].values.detach()[order]
        assert torch.equal(found[~near], first[name][~near]), name
        away = (found[near] - expected[near]).abs()
        assert float((away > 1e-4 * expected[near].abs() + 1e-6).double().mean()) < 0.02, name
        assert not torch.equal(found[near], first[name][near]), name
        state = optimizers[0].state[column.values]
        assert not state["seen"][~near].any()
        assert not state["exp_avg_sq"][~near].any()
    assert not torch.equal(free.columns["logits"].values.detach()[order][~near], first["logits"][~near])


@needs_kernels
def test_pictures_are_those_of_all_gaussians(tmp_path: Path) -> None:
    limited, free, black = built(tmp_path, memory_limit=50.0), built(tmp_path), torch.zeros(3)
    for view in (View(camera()), View(camera(), stride=3), View(camera("equirectangular"))):
        found, expected = limited.render_view(view, black), free.render_view(view, black)
        torch.testing.assert_close(found.rgb, expected.rgb, atol=1e-4, rtol=0)
        torch.testing.assert_close(found.accumulation, expected.accumulation, atol=1e-4, rtol=0)
        torch.testing.assert_close(limited.render_rgb(view, black), found.rgb, atol=1e-5, rtol=0)
    assert len(limited.gaussians_in(View(camera()))) == NEAR
    assert len(limited.gaussians()) == 2 * NEAR


@needs_kernels
@pytest.mark.medium
@pytest.mark.parametrize("strategy", ["adc", "mcmc", "relocation"])
def test_a_run_grows_and_goes_on_with_the_same_bits(
    strategy: str, shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also from a checkpoint that is mapped instead of read; and it learns as a run without a limit does."""
    settings = {"strategy": strategy, "steps_per_move": 10, "steps_per_reset": 20, "max_num_iterations": 60}
    limited = {**settings, "memory_limit": 0.2, "cache_dir": tmp_path / "cache", "machine": CPU}

    def started(name: str, flags: dict[str, Any]) -> Trainer:
        trainer = tiny_trainer("gaussian-splatting", shared_tiny, tmp_path / name, **flags)
        assert isinstance(trainer.model, GaussianSplatting)
        if trainer.model.rows_in_view is not None:
            trainer.model.rows_in_view.chunk = 32
        return trainer

    whole, parts, free = started("whole", limited), started("parts", limited), started("free", settings)
    for trainer, steps in ((whole, 38), (parts, 15), (free, 38)):
        for _ in range(steps):
            trainer.train_step()
    resumed = started("resumed", limited)
    monkeypatch.setattr("nerfloom.training.checkpoint.MAPPED_SIZE", 0)
    resumed.restore(load_checkpoint(parts.save()))
    for _ in range(23):
        resumed.train_step()
    for first, second in zip(whole.model.parameters(), resumed.model.parameters(), strict=True):
        assert torch.equal(first, second)
    counts = [len(trainer.model.gaussians()) for trainer in (whole, parts, free)]  # type: ignore[operator]
    assert counts[0] != counts[1]
    assert counts[0] > 0.8 * counts[2]
    print(whole.state.train_psnr, free.state.train_psnr)
    assert whole.state.train_psnr > free.state.train_psnr - 0.5


@needs_kernels
def test_a_run_with_a_limit_is_one_without(shared_tiny: Path, tmp_path: Path) -> None:
    """A checkpoint holds the same, so a run may go on, or be looked at, with or without."""
    flags = {"memory_limit": 50.0, "cache_dir": tmp_path / "cache", "machine": CPU}
    first = tiny_trainer("gaussian-splatting", shared_tiny, tmp_path / "first", **flags)
    for _ in range(3):
        first.train_step()
    second = tiny_trainer("gaussian-splatting", shared_tiny, tmp_path / "second")
    second.restore(load_checkpoint(first.save()))
    for one, other in zip(first.model.parameters(), second.model.parameters(), strict=True):
        assert torch.equal(one, other)
    second.train_step()
    assert second.state.step == 4


@needs_kernels
def test_tables_in_files_may_be_larger_than_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limited, free = built(tmp_path, memory_limit=50.0), built(tmp_path)
    size = 12.0 * sum(column.numel() for column in free.parameters())
    monkeypatch.setattr("nerfloom.kernels.table_memory.machine_memory", lambda: 0.5 * size)
    make_optimizer(limited, limited.config)
    with pytest.raises(ConfigError, match="for the model's parameters and Adam's state"):
        make_optimizer(free, free.config)


@needs_kernels
def test_what_has_no_limit_is_refused() -> None:
    config, _ = decide(GaussianSplattingConfig(memory_limit=1.0, machine=CPU), SCENE)
    check_limit(config, SCENE)
    with pytest.raises(ConfigError, match=r"--memory-limit is for scenes that do not move; .*, or leave it out"):
        check_limit(config, dataclasses.replace(SCENE, moving=True))
    on_gpu = dataclasses.replace(config, machine=dataclasses.replace(config.machine, device_type="cuda"))
    with pytest.raises(ConfigError, match="--memory-limit is for the CPU"):
        check_limit(on_gpu, SCENE)
    with pytest.raises(ConfigError, match="--memory-limit is -1"):
        GaussianSplattingConfig(memory_limit=-1.0)


def test_it_needs_compiled_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfloom.kernels.native.available", lambda: False)
    config = GaussianSplattingConfig(memory_limit=1.0, machine=CPU)
    with pytest.raises(ConfigError, match="--memory-limit needs the compiled kernels"):
        check_limit(config, SCENE)

"""Tiny runs for the trainer's tests."""

import dataclasses
import re
from pathlib import Path
from typing import Any

import torch

from nerfloom.dataparsers.blender import Blender
from nerfloom.registry import load_method
from nerfloom.training.checkpoint import FOLDER, load_newest
from nerfloom.training.datasets import load_split
from nerfloom.training.run import Run, create_folder
from nerfloom.training.trainer import Trainer

TINY: dict[str, dict[str, Any]] = {
    "instant-ngp": {
        "num_levels": 4,
        "max_resolution": 64,
        "log2_table_size": 12,
        "sparse_updates": True,
        "grid_resolution": 16,
        "num_steps": 64,
        "samples_per_batch": 4096,
    },
    "vanilla-nerf": {
        "num_layers": 3,
        "hidden_width": 32,
        "num_coarse_samples": 16,
        "num_fine_samples": 16,
        "num_rays_per_batch": 128,
        "learning_rate": 5e-3,
    },
    "vanilla-nerf+occupancy": {
        "num_layers": 3,
        "hidden_width": 32,
        "sampler": "occupancy",
        "grid_resolution": 16,
        "num_steps": 64,
        "samples_per_batch": 4096,
        "learning_rate": 5e-3,
    },
    "mip-nerf": {
        "num_layers": 3,
        "hidden_width": 32,
        "position_frequencies": 8,
        "num_coarse_samples": 16,
        "num_fine_samples": 16,
        "num_rays_per_batch": 128,
        "learning_rate": 5e-3,
    },
    "nerf-w": {
        "num_levels": 4,
        "max_resolution": 64,
        "log2_table_size": 12,
        "num_proposal_samples": (24, 12),
        "num_nerf_samples": 8,
        "num_rays_per_batch": 256,
        "sampler": "proposal",
        "transient_resolution": 4,
    },
    "nerf-w+frequency": {
        "encoding": "frequency",
        "sampler": "occupancy",
        "grid_resolution": 16,
        "num_steps": 64,
        "samples_per_batch": 2048,
    },
    "mip-nerf-360": {
        "encoding": "hash-grid",
        "num_levels": 4,
        "max_resolution": 64,
        "log2_table_size": 12,
        "num_proposal_samples": (24, 12),
        "num_nerf_samples": 8,
        "num_rays_per_batch": 256,
        "lr_warmup_steps": 0,
    },
    "mip-nerf-360+integrated": {
        "encoding": "integrated",
        "num_layers": 3,
        "hidden_width": 32,
        "proposal_layers": 2,
        "proposal_width": 16,
        "position_frequencies": 6,
        "num_proposal_samples": (16, 16),
        "num_nerf_samples": 8,
        "num_rays_per_batch": 128,
        "learning_rate": 5e-3,
        "lr_warmup_steps": 0,
    },
    "kilo-nerf": {
        "network_resolution": 3,
        "hidden_width": 16,
        "position_frequencies": 4,
        "grid_resolution": 16,
        "num_steps": 64,
        "samples_per_batch": 4096,
        "learning_rate": 1e-2,
    },
    "kplanes": {
        "base_resolution": 16,
        "num_scales": 2,
        "time_resolution": 5,
        "features_per_scale": 8,
        "grid_resolution": 16,
        "num_steps": 64,
        "samples_per_batch": 4096,
    },
    "gaussian-splatting": {
        "num_gaussians": 600,
        "start_gaussians": 400,
        "start": "silhouettes",
        "steps_per_move": 10,
        "rate_factor": 3.0,
    },
    "moving-gaussians": {
        "num_gaussians": 600,
        "start_gaussians": 400,
        "start": "silhouettes",
        "steps_per_move": 10,
        "rate_factor": 3.0,
    },
    "nerf-plus-plus": {
        "num_layers": 3,
        "hidden_width": 32,
        "num_coarse_samples": 16,
        "num_fine_samples": 16,
        "num_rays_per_batch": 128,
        "learning_rate": 5e-3,
    },
    "nerf-plus-plus+hash-grid": {
        "encoding": "hash-grid",
        "num_levels": 4,
        "max_resolution": 64,
        "log2_table_size": 12,
        "grid_resolution": 16,
        "num_steps": 64,
        "samples_per_batch": 4096,
        "num_background_samples": 8,
    },
    "tensorf": {
        "density_components": 8,
        "appearance_components": 8,
        "first_voxels": 16**3,
        "last_voxels": 32**3,
        "grid_resolution": 16,
        "num_steps": 64,
        "hidden_width": 32,
        "samples_per_batch": 4096,
    },
    "nerfacto": {
        "sampler": "proposal",
        "num_levels": 4,
        "max_resolution": 64,
        "log2_table_size": 12,
        "num_proposal_samples": (24, 12),
        "num_nerf_samples": 8,
        "num_rays_per_batch": 256,
    },
    "zip-nerf": {
        "sampler": "proposal",
        "num_levels": 4,
        "max_resolution": 64,
        "log2_table_size": 12,
        "num_proposal_levels": 3,
        "proposal_resolutions": (32, 64),
        "num_proposal_samples": (24, 12),
        "num_nerf_samples": 8,
        "num_rays_per_batch": 256,
    },
    "neus": {
        "num_levels": 4,
        "max_resolution": 64,
        "log2_table_size": 12,
        "grid_resolution": 16,
        "num_steps": 64,
        "hidden_width": 32,
        "samples_per_batch": 4096,
    },
    "neus+frequency": {
        "encoding": "frequency",
        "hidden_width": 32,
        "position_frequencies": 2,
        "grid_resolution": 16,
        "num_steps": 48,
        "samples_per_batch": 2048,
        "learning_rate": 5e-3,
        "start_radius": 0.6,
    },
    "ref-nerf": {
        "num_levels": 4,
        "max_resolution": 64,
        "log2_table_size": 12,
        "grid_resolution": 16,
        "num_steps": 64,
        "hidden_width": 32,
        "samples_per_batch": 4096,
    },
    "ref-nerf+frequency": {
        "encoding": "frequency",
        "hidden_width": 32,
        "bottleneck_width": 16,
        "position_frequencies": 8,
        "num_coarse_samples": 16,
        "num_fine_samples": 16,
        "num_rays_per_batch": 128,
        "learning_rate": 5e-3,
    },
    "volsdf": {
        "num_levels": 4,
        "max_resolution": 64,
        "log2_table_size": 12,
        "grid_resolution": 16,
        "num_steps": 64,
        "hidden_width": 32,
        "samples_per_batch": 4096,
    },
    "volsdf+frequency": {
        "encoding": "frequency",
        "hidden_width": 32,
        "position_frequencies": 2,
        "grid_resolution": 16,
        "num_steps": 48,
        "samples_per_batch": 2048,
        "learning_rate": 5e-3,
        "start_radius": 0.6,
    },
    "voxels": {
        "resolution": 32,
        "num_splits": 1,
        "samples_per_batch": 4096,
    },
    "pixel-nerf": {
        "num_source_views": 3,
        "images_per_batch": 4,
        "num_coarse_samples": 12,
        "num_fine_samples": 12,
        "hidden_width": 32,
        "encoder_widths": (8, 8),
        "num_rays_per_batch": 128,
        "learning_rate": 3e-3,
    },
    "dnerf": {
        "num_layers": 3,
        "hidden_width": 32,
        "deformation_layers": 2,
        "deformation_width": 32,
        "num_coarse_samples": 16,
        "num_fine_samples": 16,
        "num_rays_per_batch": 128,
        "learning_rate": 5e-3,
    },
}


def tiny_run(kind: str, data: Path, folder: Path, **changes: Any) -> Run:
    """A run of a method on the tiny data set; `kind` may carry '+variant'."""
    method = kind.split("+")[0]
    settings = {"data": data, "vis": "none", "seconds_per_save": 1e9, **TINY.get(kind, {}), **changes}
    config = dataclasses.replace(load_method(method).config, **settings)
    return Run(method, config, "blender", Blender(), folder)


def tiny_trainer(kind: str, data: Path, folder: Path, evaluated: bool = False, **changes: Any) -> Trainer:
    """A trainer with an existing folder."""
    run = tiny_run(kind, data, folder, **changes)
    create_folder(run)
    return Trainer.of(run, load_split(run, "train"), load_split(run, "val") if evaluated else None)


def tensors(trainer: Trainer) -> dict[str, torch.Tensor]:
    """Everything a run's future depends on."""
    out = {f"model.{k}": v.clone() for k, v in trainer.model.state_dict().items()}
    for index, state in trainer.optimizer.state_dict()["state"].items():
        out |= {f"optimizer.{index}.{k}": v.clone() for k, v in state.items()}
    return out


def assert_same_bits(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> None:
    """Every tensor equal to the last bit."""
    assert a.keys() == b.keys()
    different = [name for name in a if not torch.equal(a[name], b[name])]
    assert different == []


TRAINED = ("method", "scene", "transform", "scale", "model", "optimizer", "state", "errors")
"""Parts of a checkpoint that training determines; the settings name folders, which differ."""
CLOCKS = r"/state/(seconds|curve/\d+/[06]|looks/.*)"
"""Places in a checkpoint with seconds, and with values that follow from them."""


def said_otherwise(method: str, data: Path, folder: Path, facts: dict[str, Any], **settings: Any) -> Trainer:
    """A trainer on a tiny data set with other `facts` of its scene."""
    still = tiny_trainer(method, data, folder / "still").train_set
    (folder / "run").mkdir()
    changed = dataclasses.replace(still, scene=dataclasses.replace(still.scene, **facts))
    return Trainer.of(tiny_run(method, data, folder / "run", max_eval_images=0, **settings), changed)


def chosen(trainer: Trainer) -> dict[str, str]:
    """The decisions from the data, by name."""
    return {decision.option: decision.choice for decision in trainer.profile.decisions}


def differences(first: Path, second: Path) -> list[str]:
    """The differences between the newest checkpoints of two runs' folders, to the last bit; clocks do not count."""
    mine, theirs = _trained(first), _trained(second)
    return sorted(name for name in mine.keys() | theirs.keys() if not _same(mine.get(name), theirs.get(name)))


def _trained(folder: Path) -> dict[str, Any]:
    content = load_newest(folder / FOLDER)
    assert content is not None, f"{folder} has no checkpoint"
    return _leaves({key: content[key] for key in TRAINED})


def _leaves(value: Any, name: str = "") -> dict[str, Any]:
    """All values in dictionaries, lists and tuples, by where they are."""
    if isinstance(value, dict):
        items = list(value.items())
    elif isinstance(value, (list, tuple)):
        items = list(enumerate(value))
    else:
        return {} if re.fullmatch(CLOCKS, name) else {name: value}
    return {place: leaf for key, part in items for place, leaf in _leaves(part, f"{name}/{key}").items()}


def _same(one: Any, other: Any) -> bool:
    if not isinstance(one, torch.Tensor) or not isinstance(other, torch.Tensor):
        return type(one) is type(other) and one == other
    bits = [tensor.contiguous().reshape(-1).view(torch.uint8) for tensor in (one, other)]
    return one.dtype == other.dtype and one.shape == other.shape and torch.equal(*bits)

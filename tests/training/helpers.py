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

GRID = {"num_levels": 4, "max_resolution": 64, "log2_table_size": 12}
MARCHED = {"grid_resolution": 16, "num_steps": 64, "samples_per_batch": 4096}
PROPOSED = {"num_proposal_samples": (24, 12), "num_nerf_samples": 8, "num_rays_per_batch": 256}
NETWORK = {"num_layers": 3, "hidden_width": 32, "learning_rate": 5e-3}
TWO_PASSES = {"num_coarse_samples": 16, "num_fine_samples": 16, "num_rays_per_batch": 128}
GAUSSIANS = {
    "num_gaussians": 600, "start_gaussians": 400, "start": "silhouettes", "steps_per_move": 10, "rate_factor": 3.0,
}  # fmt: skip
DISTANCE = {
    "encoding": "frequency", "hidden_width": 32, "position_frequencies": 2, "grid_resolution": 16, "num_steps": 48,
    "samples_per_batch": 2048, "learning_rate": 5e-3, "start_radius": 0.6,
}  # fmt: skip
TINY: dict[str, dict[str, Any]] = {
    "instant-ngp": {**GRID, **MARCHED, "sparse_updates": True},
    "vanilla-nerf": {**NETWORK, **TWO_PASSES},
    "vanilla-nerf+occupancy": {**NETWORK, **MARCHED, "sampler": "occupancy"},
    "mip-nerf": {**NETWORK, **TWO_PASSES, "position_frequencies": 8},
    "nerf-w": {**GRID, **PROPOSED, "sampler": "proposal"},
    "nerf-w+frequency": {**MARCHED, "encoding": "frequency", "sampler": "occupancy", "samples_per_batch": 2048},
    "mip-nerf-360": {**GRID, **PROPOSED, "encoding": "hash-grid", "lr_warmup_steps": 0},
    "mip-nerf-360+integrated": {
        **NETWORK, "encoding": "integrated", "position_frequencies": 6, "num_proposal_samples": (16, 16),
        "num_nerf_samples": 8, "num_rays_per_batch": 128, "lr_warmup_steps": 0,
    },
    "kilo-nerf": {
        **MARCHED, "network_resolution": 3, "hidden_width": 16, "position_frequencies": 4, "learning_rate": 1e-2,
    },
    "kplanes": {**MARCHED, "base_resolution": 16, "num_scales": 2, "time_resolution": 5, "features_per_scale": 8},
    "gaussian-splatting": GAUSSIANS,
    "moving-gaussians": GAUSSIANS,
    "nerf-plus-plus": {**NETWORK, **TWO_PASSES},
    "nerf-plus-plus+hash-grid": {**GRID, **MARCHED, "encoding": "hash-grid", "num_background_samples": 8},
    "tensorf": {
        **MARCHED, "density_components": 8, "appearance_components": 8, "first_voxels": 16**3, "last_voxels": 32**3,
        "hidden_width": 32,
    },
    "nerfacto": {**GRID, **PROPOSED, "sampler": "proposal"},
    "zip-nerf": {**GRID, **PROPOSED, "sampler": "proposal", "proposal_resolutions": (32, 64)},
    "neus": {**GRID, **MARCHED, "hidden_width": 32},
    "neus+frequency": DISTANCE,
    "ref-nerf": {**GRID, **MARCHED, "hidden_width": 32},
    "ref-nerf+frequency": {
        **TWO_PASSES, "encoding": "frequency", "hidden_width": 32, "bottleneck_width": 16, "position_frequencies": 8,
        "learning_rate": 5e-3,
    },
    "volsdf": {**GRID, **MARCHED, "hidden_width": 32},
    "volsdf+frequency": DISTANCE,
    "voxels": {"resolution": 32, "num_splits": 1, "samples_per_batch": 4096},
    "pixel-nerf": {
        "num_source_views": 3, "images_per_batch": 4, "num_coarse_samples": 12, "num_fine_samples": 12,
        "hidden_width": 32, "encoder_widths": (8, 8), "num_rays_per_batch": 128, "learning_rate": 3e-3,
    },
    "dnerf": {**NETWORK, **TWO_PASSES},
}  # fmt: skip


def tiny_run(kind: str, data: Path, folder: Path, **changes: Any) -> Run:
    """A run of a method on the tiny data set; `kind` may carry '+variant'."""
    method = kind.split("+")[0]
    given = {"data": data, "timestamp": folder.name, "vis": "none", "seconds_per_save": 1e9}
    settings = {**given, **TINY.get(kind, {}), **changes}
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


class Malicious:
    """Makes a file, `proof`, if a pickle of it is loaded."""

    def __init__(self, proof: Path) -> None:
        self.proof = proof

    def __reduce__(self) -> tuple:
        return (Path.touch, (self.proof,))

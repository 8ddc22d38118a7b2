"""Names that users of nerfstudio type, and ours for them: plain data, and one answer a word."""

from __future__ import annotations

import re
import shlex
from collections.abc import Collection

SETTINGS = {
    "camera-optimizer.mode": "--camera-optimizer",
    "train-num-rays-per-batch": "--num-rays-per-batch",
    "eval-num-rays-per-batch": "--eval-num-rays-per-chunk",
    "camera-res-scale-factor": "--downscale-factor",
    "cache-images": "--cache-limit",
    "max-res": "--max-resolution",
    "base-res": "--base-resolution",
    "log2-hashmap-size": "--log2-table-size",
    "hidden-dim": "--hidden-width",
    "hidden-dim-color": "--hidden-width",
    "near-plane": "--near",
    "far-plane": "--far",
    "background-color": "--background",
    "num-proposal-samples-per-ray": "--num-proposal-samples",
    "num-nerf-samples-per-ray": "--num-nerf-samples",
    "num-coarse-samples": "--num-coarse-samples",
    "num-importance-samples": "--num-fine-samples",
    "appearance-embed-dim": "--appearance-embedding-dim",
    "use-appearance-embedding": "--appearance-embedding-dim",
    "use-average-appearance-embedding": "--eval-appearance",
    "disable-scene-contraction": "--contraction",
    "use-gradient-scaling": "--gradient-scaling",
    "eval-image-indices": "--max-eval-images",
    "lr": "--learning-rate",
    "eps": "--adam-eps",
    "lr-final": "--lr-final",
    "warmup-steps": "--lr-warmup-steps",
    "max-steps": "--max-num-iterations",
    "load-step": "--load-checkpoint",
}
"""The end of a flag of nerfstudio's -> the flag that does it here. Flags of the same name need no entry."""
CAMERA_SETTINGS = {"lr": "--camera-learning-rate"}
"""The same where the flag is about the cameras' optimiser."""
SECTIONS = {
    "viewer": "there is no viewer; --vis tensorboard shows pictures and curves, and ns-render makes animations",
    "logging": "leave it out; --vis tensorboard or none is all there is to say",
    "optimizers": "Adam is the one optimiser, with --learning-rate, --lr-schedule and --lr-final",
    "pipeline": "flags have no sections here, and none does this; ns-train {method} --help lists them",
    "trainer": "flags have no sections here, and none does this; ns-train {method} --help lists them",
    "machine": "a run is one process on one device: --machine.device-type",
    "steps-per-eval-batch": "leave it out; --steps-per-eval-all-images evaluates whole photographs",
    "use-grad-scaler": "leave it out; bfloat16 needs none",
    "gradient-accumulation-steps": "a larger --num-rays-per-batch does the same",
    "project-name": "the run's folder is named by --experiment-name",
    "relative-model-dir": "checkpoints are in the run's folder nerfstudio_models",
    "load-scheduler": "leave it out; a checkpoint brings the schedule",
    "log-gradients": "leave it out; a step that is not finite is dropped and counted",
    "prompt": "nothing here is made from words",
    "start-paused": "leave it out; there is no viewer",
}
"""The beginning of a flag of nerfstudio's -> what to say where no flag does it here."""
VIEWERS = ("viewer", "viewer_legacy", "viewer_beta", "wandb", "comet")
"""Values of nerfstudio's --vis, alone or joined by +, that ours does not take."""
FORMATS = {
    "blender-data": "blender",
    "colmap-data": "colmap",
    "dnerf-data": "dnerf",
    "instant-ngp-data": "nerfstudio",
    "nerfstudio-data": "nerfstudio",
    "phototourism-data": "phototourism",
}
"""nerfstudio's data subcommands -> our data formats."""
NO_FORMATS = (
    "arkitscenes-data", "dycheck-data", "mill19-data", "minimal-parser", "nerfosr-data", "nuscenes-data",
    "scannet-data", "scannetpp-data", "sdfstudio-data", "sitcoms3d-data",
)  # fmt: skip
"""nerfstudio's data subcommands of which there is no format here."""
_MESH = "meshes are not made here; 'pointcloud' writes points and normals, of which other programs make meshes"
_OTHER_POSES = "export its cameras in COLMAP's format, and give that folder to ns-train --data; no processing is needed"
KINDS = {
    "camera-path": "paths of nerfstudio's viewer are not read; there are 'orbit', 'interpolate' and 'time'",
    "spiral": "there are 'orbit', 'interpolate' and 'time'",
    "dataset": "ns-eval RUN_FOLDER --render-output-path DIR renders the held-out photographs",
    "poisson": _MESH,
    "tsdf": _MESH,
    "marching-cubes": _MESH,
    "gaussian-splat": "there are no Gaussians here; 'pointcloud' writes points",
    "metashape": _OTHER_POSES,
    "realitycapture": _OTHER_POSES,
    "odm": _OTHER_POSES,
    "aria": "it is not read here",
}
"""Subcommands of nerfstudio's ns-render, ns-export and ns-process-data that are none of ours -> what to do here."""


def vis_answer(value: str) -> str | None:
    """The answer to a value of --vis that nerfstudio has and we have not; None for any other."""
    foreign = set(value.split("+")) & set(VIEWERS)
    return f"--vis {value} is nerfstudio's; {SECTIONS['viewer']}" if foreign else None


def flag_answer(flag: str, method: str, known: Collection[str]) -> str | None:
    """The answer to a flag that nerfstudio has and we have not; None for any other.

    Args:
        flag: as it was typed, perhaps with =VALUE.
        method: which is trained.
        known: our flags for it, with their dashes.
    """
    name = flag.removeprefix("--").partition("=")[0].replace("_", "-")
    beginning = name.partition(".")[0]
    if f"--{name}" in known or (beginning not in SECTIONS and name not in SETTINGS):
        return None
    ours = _ours(name)
    answer = f"here it is {ours}" if ours in known else SECTIONS.get(beginning, "{method} has no such flag")
    return f"--{name} is nerfstudio's; {answer.format(method=method)}"


def _ours(name: str) -> str:
    """The flag that would do here what nerfstudio's of this name does."""
    settings = SETTINGS | (CAMERA_SETTINGS if name.startswith("optimizers.camera") else {})
    parts = name.split(".")
    ends = [".".join(parts[start:]) for start in range(len(parts))]
    return next((settings[end] for end in ends if end in settings), f"--{parts[-1]}")


def format_answer(name: str) -> str | None:
    """The answer to a data subcommand of nerfstudio's; None for any other word."""
    if name in FORMATS:
        return f"'{name}' is nerfstudio's; here the data format is called '{FORMATS[name]}'"
    if name in NO_FORMATS:
        return f"'{name}' is nerfstudio's, and is not read here; 'nerfstudio', a transforms.json, is easily written"
    return None


def config_answer(text: str) -> str | None:
    """The answer to a YAML file's text where it is a config.yml of nerfstudio's; None for any other.

    It is searched for the method and the data, and never loaded, for that would make its Python objects.
    """
    if not text.startswith("!!python/object:nerfstudio."):
        return None
    method = re.search(r"^method_name: ([\w-]+)$", text, re.MULTILINE)
    data = re.search(r"^data: (?:&\w+ )?!!python/object/apply:pathlib\.\w+\n((?:- .+\n)+)", text, re.MULTILINE)
    parts = re.findall(r"^- ['\"]?(.+?)['\"]?$", data[1], re.MULTILINE) if data else ["DIR"]
    train = f"ns-train {method[1] if method else 'METHOD'} --data {shlex.quote('/'.join(parts).replace('//', '/'))}"
    return f"is nerfstudio's; its Python objects are not loaded, and its checkpoints are of other networks: {train}"

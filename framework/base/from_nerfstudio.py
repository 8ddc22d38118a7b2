"""Answers to nerfstudio's flags, subcommands and configs: the equivalents here."""

from __future__ import annotations

import difflib
import re
import shlex
from collections.abc import Collection, Mapping

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
    "use-appearance-embedding": "--appearance",
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
    "sh-degree": "--degree",
    "max-gs-num": "--num-gaussians",
    "ssim-lambda": "--ssim-weight",
    "stop-split-at": "--growth-end",
}
"""Last part of a nerfstudio flag -> the equivalent flag here. Flags of the same name need no entry."""
TAKEN = (
    "background-color", "base-res", "camera-optimizer.mode", "distortion-loss-mult",
    "downscale-factor", "eval-interval", "eval-mode", "eval-num-rays-per-chunk", "features-per-level",
    "log2-hashmap-size", "max-gs-num", "max-num-iterations", "max-res", "num-coarse-samples", "num-importance-samples",
    "num-levels", "num-nerf-samples-per-ray", "num-proposal-samples-per-ray", "orientation-loss-mult",
    "predict-normals", "sh-degree", "ssim-lambda", "train-num-rays-per-batch", "train-split-fraction",
    "use-gradient-scaling",
)  # fmt: skip
"""Last parts of the nerfstudio flags that are accepted: they have the same meaning and the same values here."""
SPELLINGS = {
    "iterations": "--max-num-iterations",
    "iters": "--max-num-iterations",
    "max-iterations": "--max-num-iterations",
    "max-iters": "--max-num-iterations",
    "max-steps": "--max-num-iterations",
    "n-steps": "--max-num-iterations",
    "num-iterations": "--max-num-iterations",
    "lr": "--learning-rate",
    "seed": "--machine.seed",
    "sh-degree": "--degree",
    "source-path": "--data",
}
"""Flag of another program, without prefix -> the flag here with the same meaning. These are accepted."""
CAMERA_SETTINGS = {"lr": "--camera-learning-rate"}
"""Like `SETTINGS`, for flags of the camera optimiser."""
SECTIONS = {
    "viewer": "the viewer's flags here are --viewer.websocket-host, --viewer.websocket-port and --viewer-share",
    "logging": "leave it out; the choice here is --vis viewer, tensorboard, viewer+tensorboard or none",
    "optimizers": "Adam is the only optimiser, with --learning-rate, --lr-schedule and --lr-final",
    "pipeline": "there is no equivalent flag; ns-train {method} --help-all lists all flags",
    "trainer": "there is no equivalent flag; ns-train {method} --help-all lists all flags",
    "machine": "a process has one device, --machine.device-type; torchrun starts several (docs/guides/processes.md)",
    "steps-per-eval-batch": "leave it out; --steps-per-eval-all-images evaluates whole images",
    "use-grad-scaler": "leave it out; bfloat16 needs no gradient scaling",
    "gradient-accumulation-steps": "a larger --num-rays-per-batch has the same effect",
    "project-name": "the run's folder is named by --experiment-name",
    "relative-model-dir": "checkpoints are in the run's folder nerfstudio_models",
    "load-scheduler": "leave it out; a checkpoint includes the schedule",
    "log-gradients": "leave it out; a step that is not finite is dropped and counted",
    "prompt": "no method here uses text prompts",
    "start-paused": "leave it out; the viewer has a button that pauses training",
}
"""First part of a nerfstudio flag -> the answer if no flag here is equivalent."""
VIEWERS = ("viewer_legacy", "viewer_beta", "wandb", "comet")
"""Values of nerfstudio's --vis, alone or joined by +, that are not available here."""
FORMATS = {
    "blender-data": "blender",
    "colmap-data": "colmap",
    "dnerf-data": "dnerf",
    "instant-ngp-data": "nerfstudio",
    "nerfstudio-data": "nerfstudio",
    "phototourism-data": "phototourism",
    "sdfstudio-data": "sdfstudio",
}
"""Data subcommand of nerfstudio -> data format here."""
NO_FORMATS = (
    "arkitscenes-data", "dycheck-data", "mill19-data", "minimal-parser", "nerfosr-data", "nuscenes-data",
    "scannet-data", "scannetpp-data", "sitcoms3d-data",
)  # fmt: skip
"""Data subcommands of nerfstudio without a data format here."""
_MESH = "use 'marching-cubes' (methods with density) or 'tsdf' (all methods) for meshes"
KINDS = {
    "poisson": _MESH,
}
"""Subcommand of nerfstudio's ns-export or ns-process-data without an equivalent -> advice."""


RENDERING = {
    "output-format": "the extension of --output-path sets the format; without one, images are written to a folder",
    "jpeg-quality": "leave it out; JPEG images have quality 95",
    "frame-rate": "here it is --fps",
    "interpolation-steps": "here it is --seconds or --num-frames, for the whole path",
    "pose-source": "leave it out; the path follows the training cameras",
    "order-poses": "leave it out; the path passes cameras along a short tour",
    "camera-idx": "leave it out; the mean appearance of all images is shown",
    "render-nearest-camera": "there is no equivalent; 'ns-render dataset' shows views beside their true images",
    "check-occlusions": "there is no equivalent; 'ns-render dataset' shows views beside their true images",
    "colormap-options": "leave it out; depth is in viridis, between --depth-near-plane and --depth-far-plane",
    "eval-num-rays-per-chunk": "leave it out; it is a setting of the run",
}
"""First part of a flag of nerfstudio's ns-render without an equivalent of the same name -> the answer."""


EXPORTING = {
    "bounding-box-min": "here it is --crop-box X,Y,Z,X,Y,Z, with both corners",
    "bounding-box-max": "here it is --crop-box X,Y,Z,X,Y,Z, with both corners",
    "use-bounding-box": "leave it out; only --crop-box, --crop-sphere and --region cut something off",
    "obb-center": "here it is --crop-box X,Y,Z,X,Y,Z, or a rotated box in the file of --region",
    "obb-rotation": "here it is a rotated box in the file of --region",
    "obb-scale": "here it is --crop-box X,Y,Z,X,Y,Z, or a rotated box in the file of --region",
    "save-world-frame": "leave it out; all files are in the frame of the input",
    "normal-method": "leave it out; normals are those of the surface",
    "num-rays-per-batch": "leave it out; it is a setting of the run",
}
"""First part of a flag of nerfstudio's ns-export without an equivalent of the same name -> the answer."""


def command_answer(flag: str, answers: Mapping[str, str], command: str) -> str | None:
    """Return the answer to a `flag` of a `command` of nerfstudio; None for other words.

    Args:
        flag: a word of the command line, possibly with =VALUE.
        answers: `RENDERING` or `EXPORTING`.
        command: name of the command.
    """
    name = flag.removeprefix("--").partition("=")[0].replace("_", "-")
    answer = answers.get(name.partition(".")[0]) if flag.startswith("--") else None
    return None if answer is None else f"--{name} is of nerfstudio's {command}; {answer}"


def vis_answer(value: str) -> str | None:
    """Return the answer to a `value` of nerfstudio's --vis that is not available here; None for other values."""
    foreign = set(value.split("+")) & set(VIEWERS)
    return f"--vis {value} is nerfstudio's; {SECTIONS['logging']}" if foreign else None


def taken(words: list[str], known: Collection[str]) -> tuple[list[str], list[str]]:
    """Replace nerfstudio's flags and formats in a command line by the equivalents here.

    All other words stay as they are.

    Args:
        words: flags and their values.
        known: flags of the method, with their dashes.

    Returns:
        The words, and a line to print for each replaced word.
    """
    ours, notes = [], []
    for index, word in enumerate(words):
        flag, equals, value = word.partition("=") if word.startswith("--") else (word, "", "")
        name = _ours(flag, known)
        if flag in FORMATS and not (index and words[index - 1].startswith("--") and "=" not in words[index - 1]):
            name = FORMATS[flag]
        if name is not None:
            notes.append(f"{flag} is taken as {name}, which means the same")
        ours.append((name or flag) + equals + value)
    return ours, notes


def _ours(flag: str, known: Collection[str]) -> str | None:
    """Return the flag with the same meaning as a flag of nerfstudio or another program; None for other words."""
    name = flag.removeprefix("--").replace("_", "-")
    if not flag.startswith("--") or f"--{name}" in known:
        return None
    prefix, dot, _ = name.partition(".")
    ours = SPELLINGS.get(name)
    if dot and prefix in ("pipeline", "trainer") and any(name.endswith(f".{end}") for end in TAKEN):
        ours = _equivalent(name)
    of_data = ("--downscale-factor", "--eval-interval", "--eval-mode", "--train-split-fraction")
    return ours if ours in known or ours in of_data else None


def flag_answer(flag: str, method: str, known: Collection[str]) -> str | None:
    """Return the answer to a `flag` of nerfstudio that does not exist here; None for other flags.

    The flag may have =VALUE. `known` are the flags of the `method`, with their dashes.
    """
    name = flag.removeprefix("--").partition("=")[0].replace("_", "-")
    beginning = name.partition(".")[0]
    if f"--{name}" in known or (beginning not in SECTIONS and name not in SETTINGS):
        return None
    ours = _equivalent(name)
    answer = f"here it is {ours}" if ours in known else SECTIONS.get(beginning, "{method} has no such flag")
    near = difflib.get_close_matches(ours, known, n=1) if ours not in known else []
    answer += f"; the nearest is {near[0]}" if near else ""
    return f"--{name} is nerfstudio's; {answer.format(method=method)}"


def _equivalent(name: str) -> str:
    """Return the flag that is equivalent to a nerfstudio flag."""
    settings = SETTINGS | (CAMERA_SETTINGS if name.startswith("optimizers.camera") else {})
    parts = name.split(".")
    ends = [".".join(parts[start:]) for start in range(len(parts))]
    return next((settings[end] for end in ends if end in settings), f"--{parts[-1]}")


def format_answer(name: str) -> str | None:
    """Return the answer to the `name` of a data subcommand of nerfstudio; None for other words."""
    if name in FORMATS:
        return f"'{name}' is nerfstudio's; here the data format is called '{FORMATS[name]}'"
    if name in NO_FORMATS:
        return (
            f"'{name}' is nerfstudio's, and is not supported here; convert the data to 'nerfstudio', a transforms.json"
        )
    return None


def config_answer(text: str) -> str | None:
    """Return the answer to a config.yml of nerfstudio; None for other files.

    The function searches the text for the method and the data. Loading the YAML would construct its Python objects.

    Args:
        text: content of a YAML file.
    """
    if not text.startswith("!!python/object:nerfstudio."):
        return None
    method = re.search(r"^method_name: ([\w-]+)$", text, re.MULTILINE)
    data = re.search(r"^data: (?:&\w+ )?!!python/object/apply:pathlib\.\w+\n((?:- .+\n)+)", text, re.MULTILINE)
    parts = re.findall(r"^- ['\"]?(.+?)['\"]?$", data[1], re.MULTILINE) if data else ["DIR"]
    train = f"ns-train {method[1] if method else 'METHOD'} --data {shlex.quote('/'.join(parts).replace('//', '/'))}"
    return f"is nerfstudio's; its networks differ, so that its checkpoints cannot be loaded; train again: {train}"

"""The command `ns-render`: images and animations of a trained run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from framework.base.config import RaysPerPixel
from framework.base.errors import ConfigError
from framework.cli.common import chosen_kind, make_room, run_command, with_run

if TYPE_CHECKING:
    from torch import Tensor

    from framework.cameras.cameras import Cameras
    from framework.data.dataset import ParsedScene
    from framework.training.trained import Trained

USAGE = """\
usage: ns-render PATH RUN_FOLDER --output-path FILE.gif [flags]

paths:
  orbit           a horizontal circle around the scene, with the mean height and distance of the training cameras
  interpolate     a smooth path past the training cameras, in the order of their images' names
  time            one of the cameras, while time runs from 0 to 1

ns-render PATH --help shows its flags.
"""


@dataclass(frozen=True)
class RenderFlags:
    """Flags of every path."""

    load_config: Path
    """Folder of the run, or its config.yml; the flag's name may be omitted."""
    fps: float = 16.0
    """Frames per second."""
    downscale_factor: int = 1
    """Integer factor by which width and height are reduced."""
    rays_per_pixel: RaysPerPixel | None = None
    """Rays per pixel, of which its colour is the mean; the run's setting if not given."""
    max_error: str | None = None
    """Maximum error of a colour, such as 1/255: rays end where the rest cannot change it by more; 1e-4 if not given."""
    load_checkpoint: Path | None = None
    """Checkpoint to load; the newest if not given."""
    data: Path | None = None
    """Folder of the data, if it has moved since training."""
    device_type: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    """Device to render on."""


@dataclass(frozen=True)
class OrbitFlags(RenderFlags):
    """Render a horizontal circle around the scene, with the mean height and distance of the training cameras."""

    output_path: Path = Path("orbit.gif")
    """Animation to write; its extension (.gif, .webp, .png) is the format."""
    num_frames: int = 48
    """Number of frames."""
    time: float | None = None
    """Time of all frames of a scene that moves, 0 to 1. If not given, it runs from 0 to 1."""


@dataclass(frozen=True)
class TimeFlags(RenderFlags):
    """Render the view of one camera while time runs from 0 to 1."""

    output_path: Path = Path("time.gif")
    """File to write: an animation (.gif, .webp), or the frames side by side (.png)."""
    num_frames: int = 32
    """Number of frames."""
    split: Literal["train", "val", "test"] = "test"
    """Split of which --camera-index counts the cameras."""
    camera_index: int = 0
    """Index of the camera, from 0."""


@dataclass(frozen=True)
class InterpolateFlags(RenderFlags):
    """Render a smooth path past the training cameras, in the order of their images' names."""

    output_path: Path = Path("interpolate.gif")
    """Animation to write; its extension (.gif, .webp, .png) is the format."""
    num_frames: int = 96
    """Number of frames."""


Flags = OrbitFlags | InterpolateFlags | TimeFlags
PATHS: dict[str, type[Flags]] = {"orbit": OrbitFlags, "interpolate": InterpolateFlags, "time": TimeFlags}


def main() -> None:
    """Run ns-render on the arguments of the process."""
    run_command(_command)


def _command(arguments: list[str]) -> None:
    if (chosen := chosen_kind(arguments, PATHS, USAGE, "unknown path")) is None:
        return
    import tyro

    name, path, rest = chosen
    _render(tyro.cli(path, prog=f"ns-render {name}", args=with_run(rest), config=(tyro.conf.FlagConversionOff,)))


def _render(flags: Flags) -> None:
    if flags.num_frames < 1 or not flags.fps > 0 or flags.downscale_factor < 1:
        raise ConfigError("--num-frames and --downscale-factor must be at least 1, --fps more than 0")
    if flags.output_path.suffix.lower() not in (".gif", ".webp", ".png"):
        raise ConfigError(f"--output-path {flags.output_path}: the extension must be .gif, .webp or .png")
    make_room(flags.output_path)
    from contextlib import nullcontext

    import torch

    from framework.base.console import say, track
    from framework.cameras.view import View
    from framework.evaluation.error_bound import limited_error, parse_error
    from framework.evaluation.evaluator import evaluation_background
    from framework.evaluation.images import write_animation, write_image
    from framework.training.trained import load_trained

    trained = load_trained(
        flags.load_config, flags.load_checkpoint, flags.device_type, flags.data, flags.rays_per_pixel
    )
    model = trained.model
    parsed = trained.run.parse(flags.split if isinstance(flags, TimeFlags) else "train")
    cameras, times = _path(flags, trained, parsed)
    cameras = cameras.scaled(1 / (flags.downscale_factor * parsed.downscale_factor)).to(model.device)
    times = None if times is None else times.to(model.device)
    background = evaluation_background(model)
    bound = None if flags.max_error is None else parse_error(flags.max_error)
    frames = []
    with nullcontext() if bound is None else limited_error(model, bound):
        for index in track(range(flags.num_frames), "Rendering", total=flags.num_frames):
            frames.append(model.render_view(View.of(cameras, index, times), background).rgb)
    if isinstance(flags, TimeFlags) and flags.output_path.suffix.lower() == ".png":
        write_image(flags.output_path, torch.cat(frames, dim=1))
        say(f"frames, side by side: {flags.output_path}")
    else:
        write_animation(flags.output_path, frames, flags.fps)
        say(f"animation: {flags.output_path}")


def _path(flags: Flags, trained: Trained, parsed: ParsedScene) -> tuple[Cameras, Tensor | None]:
    """Return the cameras of a path and, if the scene moves, their times."""
    import torch

    from framework.evaluation.paths import interpolate

    if isinstance(flags, TimeFlags):
        return _one_camera(flags, trained, parsed)
    if isinstance(flags, OrbitFlags):
        return _circle(flags, trained, parsed)
    times = torch.linspace(0, 1, flags.num_frames) if trained.model.scene.moving else None
    return interpolate(parsed.cameras, flags.num_frames), times


def _circle(flags: OrbitFlags, trained: Trained, parsed: ParsedScene) -> tuple[Cameras, Tensor | None]:
    import torch

    from framework.evaluation.paths import orbit

    scene = trained.model.scene
    if scene.warped:
        raise ConfigError("ns-render orbit: this run knows what its cameras look at from the front only (--ndc)")
    cameras = orbit(parsed.cameras, scene.box.mean(0).cpu(), flags.num_frames)
    if flags.time is None:
        return cameras, torch.linspace(0, 1, flags.num_frames) if scene.moving else None
    if not scene.moving:
        raise ConfigError(f"--time {flags.time:g}: the photographs of this run have no times")
    if not 0 <= flags.time <= 1:
        raise ConfigError(f"--time is {flags.time:g}; it must be from 0 to 1")
    return cameras, torch.full((flags.num_frames,), flags.time)


def _one_camera(flags: TimeFlags, trained: Trained, parsed: ParsedScene) -> tuple[Cameras, Tensor | None]:
    import torch

    if not trained.model.scene.moving:
        raise ConfigError("ns-render time: the photographs of this run have no times")
    if not 0 <= flags.camera_index < len(parsed.cameras):
        last = len(parsed.cameras) - 1
        raise ConfigError(f"--camera-index is {flags.camera_index}; '{flags.split}' has cameras 0 to {last}")
    chosen = torch.full((flags.num_frames,), flags.camera_index)
    return parsed.cameras[chosen], torch.linspace(0, 1, flags.num_frames)


if __name__ == "__main__":
    main()

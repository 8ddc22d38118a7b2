"""ns-render: pictures and animations of a trained run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from framework.cli.common import run_command
from framework.config import RaysPerPixel
from framework.errors import ConfigError, nearest

USAGE = """\
usage: ns-render orbit --load-config RUN/config.yml --output-path FILE.gif [flags]

paths:
  orbit           a horizontal circle around the scene, as high and far as the training cameras

ns-render PATH --help shows its flags.
"""


@dataclass(frozen=True)
class OrbitFlags:
    """Render a horizontal circle around the scene, as high and far as the training cameras."""

    load_config: Path
    """The run's config.yml."""
    output_path: Path = Path("orbit.gif")
    """The animation; its ending (.gif, .webp, .png) chooses the format."""
    num_frames: int = 48
    """Pictures in the circle."""
    fps: float = 16.0
    """Pictures per second."""
    downscale_factor: int = 1
    """Reduce the pictures by this whole number."""
    rays_per_pixel: RaysPerPixel | None = None
    """Rays of which a pixel is the mean: more are closer to a photograph. As the run says if not given."""
    max_error: str | None = None
    """Rays end where the rest cannot change a colour by more than this, such as 1/255; 1e-4 if not given."""
    load_checkpoint: Path | None = None
    """A checkpoint other than the run's newest."""
    data: Path | None = None
    """The data's folder, where it has moved since training."""
    device_type: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    """Device to render on."""


def main() -> None:
    """The ns-render command."""
    run_command(_command)


def _command(arguments: list[str]) -> None:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE)
        return
    if arguments[0] != "orbit":
        raise ConfigError(f"unknown path '{arguments[0]}'. {nearest(arguments[0], ['orbit'])}")
    import tyro

    _orbit(tyro.cli(OrbitFlags, prog="ns-render orbit", args=arguments[1:], config=(tyro.conf.FlagConversionOff,)))


def _orbit(flags: OrbitFlags) -> None:
    if flags.num_frames < 1 or not flags.fps > 0 or flags.downscale_factor < 1:
        raise ConfigError("--num-frames and --downscale-factor must be at least 1, --fps more than 0")
    if flags.output_path.suffix.lower() not in (".gif", ".webp", ".png"):
        raise ConfigError(f"--output-path {flags.output_path}: the ending must be .gif, .webp or .png")
    from contextlib import nullcontext

    import torch

    from framework.console import say, track
    from framework.evaluation.error_bound import limited_error, parse_error
    from framework.evaluation.evaluator import evaluation_background, render_image
    from framework.evaluation.images import write_animation
    from framework.evaluation.paths import orbit
    from framework.training.trained import load_trained

    trained = load_trained(
        flags.load_config, flags.load_checkpoint, flags.device_type, flags.data, flags.rays_per_pixel
    )
    model, scene = trained.model, trained.model.scene
    parsed = trained.run.parser.parse(trained.run.config.data, "train")
    cameras = orbit(parsed.cameras, scene.box.mean(0), flags.num_frames)
    cameras = cameras.scaled(1 / (flags.downscale_factor * parsed.downscale_factor)).to(model.device)
    times = torch.linspace(0, 1, flags.num_frames, device=model.device) if scene.moving else None
    background = evaluation_background(model)
    bound = None if flags.max_error is None else parse_error(flags.max_error)
    frames = []
    with nullcontext() if bound is None else limited_error(model, bound):
        for index in track(range(flags.num_frames), "Rendering", total=flags.num_frames):
            frames.append(render_image(model, cameras, index, background, times).rgb)
    write_animation(flags.output_path, frames, flags.fps)
    say(f"animation: {flags.output_path}")


if __name__ == "__main__":
    main()

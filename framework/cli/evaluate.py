"""The command `ns-eval`: metrics of a trained run on held-out views."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from nerfloom.base.config import RaysPerPixel
from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.cli.common import make_room, run_command, with_format, with_run
from nerfloom.cli.flags import read_flags
from nerfloom.training.run_path import check_writable, trained_run


@dataclass(frozen=True)
class EvalFlags:
    """Compute PSNR, SSIM and LPIPS of a trained run on held-out views."""

    load_config: Path
    """RUN_FOLDER, its config.yml, a folder above (its newest run), or a file of Gaussians (.ply, .spz, .splat); the
    flag's name may be left out."""
    output_path: Path | None = None
    """JSON file to write. If not given: eval.json beside config.yml, or NAME.eval.json beside a file of Gaussians."""
    render_output_path: Path | None = None
    """Folder for each view's render, true image, and comparison (image, render, error, depth, opacity)."""
    max_pictures: int | None = None
    """Maximum number of views with pictures in that folder, evenly spaced, besides worst.png; all if not given."""
    load_checkpoint: Path | None = None
    """Checkpoint to load; the newest if not given."""
    data: Path | None = None
    """Folder of the data, if it has moved since training; needed with a file of Gaussians."""
    split: Literal["test", "val", "train"] = "test"
    """Split to evaluate."""
    max_images: int | None = None
    """Maximum number of evaluated images, evenly spaced; all if not given."""
    rays_per_pixel: RaysPerPixel | None = None
    """Rays per pixel, of which its colour is the mean; the run's setting if not given."""
    eval_appearance: Literal["mean", "half"] | None = None
    """Appearance of held-out images. mean: the mean of the training images'. half: fitted to the left half of each,
    with metrics of the right half (NeRF-W's protocol). The run's setting if not given."""
    lpips_weights: Path | None = None
    """File of weights of LPIPS with AlexNet (.npz); the run's setting if not given."""
    max_error: str | None = None
    """Maximum error of a colour, such as 1/255: rays end where the rest cannot change it by more; 1e-4 if not given."""
    round_to_uint8: bool = False
    """Round colours to 8 bits before they are measured."""
    device_type: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    """Device to render on."""


def main() -> None:
    """Run ns-eval on the arguments of the process."""
    run_command(_command)


def _command(arguments: list[str]) -> None:
    words, named = with_format("ns-eval", with_run(arguments))
    flags = read_flags(EvalFlags, "ns-eval", words, takes="RUN_FOLDER")
    if flags.max_images is not None and flags.max_images < 1:
        raise FlagError(f"--max-images is {flags.max_images}; it must be at least 1")
    if flags.max_pictures is not None and flags.max_pictures < 0:
        raise FlagError(f"--max-pictures is {flags.max_pictures}; it must be at least 0")
    flags = replace(flags, load_config=trained_run(flags.load_config, flags.load_checkpoint, flags.data))
    output = flags.output_path or _beside(flags.load_config)
    make_room(output)
    if flags.render_output_path is not None:
        check_writable(flags.render_output_path, "pictures to")
    from contextlib import nullcontext

    from nerfloom.base.console import say
    from nerfloom.evaluation.error_bound import limited_error, measured_error, parse_error
    from nerfloom.evaluation.evaluator import evaluate
    from nerfloom.training.datasets import load_split
    from nerfloom.training.report import write_evaluation
    from nerfloom.training.splat_files import load_run_or_splats

    trained = load_run_or_splats(
        flags.load_config,
        flags.load_checkpoint,
        flags.device_type,
        flags.data,
        flags.rays_per_pixel,
        flags.eval_appearance,
        named,
    )
    dataset = load_split(trained.run, flags.split).to(trained.model.device)
    bound = None if flags.max_error is None else parse_error(flags.max_error)
    with nullcontext() if bound is None else limited_error(trained.model, bound):
        evaluation = evaluate(
            trained.model,
            dataset,
            max_images=flags.max_images,
            pictures=flags.render_output_path,
            max_pictures=flags.max_pictures,
            round_to_uint8=flags.round_to_uint8,
            lpips_weights=flags.lpips_weights,
        )
    say(f"{flags.split}: {evaluation.line()}")
    if evaluation.far_below is not None:
        say(f"  {evaluation.far_below}")
    if bound is not None:
        worst, faster = measured_error(trained.model, dataset, bound)
        say(f"--max-error {bound:.2g}: colours off by at most {worst:.2g} (measured), {faster:.2f} x as fast as exact")
    if flags.eval_appearance == "half" and evaluation.eval_appearance is None:
        say("--eval-appearance half: this run has no appearance vectors; whole images were evaluated")
    say(f"LPIPS: {evaluation.lpips_note}")
    if evaluation.masks_note is not None:
        say(f"masks: {evaluation.masks_note}")
    write_evaluation(output, trained.run, trained.checkpoint, evaluation, trained.model.device)
    say(f"written to {output}")
    if (wrong := evaluation.pictures_note or evaluation.warning) is not None:
        raise ConfigError(wrong)


def _beside(run: Path) -> Path:
    """Return the file of the results of a run, by its settings, or of a file of Gaussians."""
    return run.parent / "eval.json" if run.suffix == ".yml" else run.with_suffix(".eval.json")


if __name__ == "__main__":
    main()

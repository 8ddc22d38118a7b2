"""The command `ns-eval`: metrics of a trained run, a file of Gaussians or an octree on held-out views."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from nerfloom.base.config import HeldOutAppearance, RaysPerPixel
from nerfloom.base.errors import ConfigError, FlagError, NerfloomError
from nerfloom.blocks.files import is_blocks_file
from nerfloom.cli.common import entry_point, make_room, with_format, with_run
from nerfloom.cli.flags import read_flags
from nerfloom.cli.geometry_flags import GeometryFlags
from nerfloom.cli.run_flags import OPENS, RunFlags
from nerfloom.training.run_path import check_writable


@dataclass(frozen=True, kw_only=True)
class EvalFlags(GeometryFlags, RunFlags):
    """Compute PSNR, SSIM and LPIPS of a run, or with --data of a file of Gaussians or an octree, on held-out views.

    With --reference-mesh or --reference-points, also compare its surface with the true one."""

    output_path: Path | None = None
    """JSON file to write. Default: eval.json beside config.yml, or NAME.eval.json beside any other file."""
    render_output_path: Path | None = None
    """Folder for each view's render, true image, and comparison (image, render, error, depth, opacity)."""
    max_pictures: int | None = None
    """Maximum number of views with pictures in that folder, evenly spaced, besides worst.png. Default: all."""
    split: Literal["test", "val", "train"] = "test"
    """Split to evaluate."""
    max_images: int | None = None
    """Maximum number of evaluated images, evenly spaced. Default: all."""
    rays_per_pixel: RaysPerPixel | None = None
    """Rays averaged per pixel. Default: the run's setting."""
    eval_appearance: HeldOutAppearance | None = None
    """Appearance of held-out images. mean: the mean of the training images'; half: fitted to the left half of each
    image, with metrics of the right half (NeRF-W's protocol); nearest: the training image's with the nearest camera.
    Default: the run's setting."""
    lpips_weights: Path | None = None
    """File of LPIPS weights with AlexNet (.npz). Default: the run's setting."""
    max_error: str | None = None
    """End rays where the rest cannot change a colour by more than this, such as 1/255. Default: 1e-4."""
    round_to_uint8: bool = False
    """Round colours to 8 bits before computing metrics."""
    mesh: Path | None = None
    """Existing mesh (.ply, .obj, .glb) to compare with the reference instead of one made by --surface."""


@entry_point
def main(arguments: list[str]) -> None:
    """Run ns-eval on the `arguments` of the process."""
    words, named = with_format("ns-eval", with_run(arguments, ("--f-score-at",)))
    flags = read_flags(EvalFlags, "ns-eval", words, takes=OPENS)
    if flags.max_images is not None and flags.max_images < 1:
        raise FlagError(f"--max-images is {flags.max_images}; it must be at least 1")
    if flags.max_pictures is not None and flags.max_pictures < 0:
        raise FlagError(f"--max-pictures is {flags.max_pictures}; it must be at least 0")
    flags.check_geometry()
    if flags.mesh is not None and flags.reference is None:
        raise FlagError("--mesh is compared with a reference: give --reference-mesh or --reference-points")
    found = flags.check()
    output = flags.output_path or _beside(found)
    make_room(output)
    if flags.render_output_path is not None:
        check_writable(flags.render_output_path, "pictures to")
    from contextlib import nullcontext
    from typing import Any

    from nerfloom.base.console import say
    from nerfloom.cli.evaluate_geometry import evaluate_geometry, read_reference
    from nerfloom.evaluation.error_bound import limited_error, measured_error, parse_error
    from nerfloom.evaluation.evaluator import evaluate
    from nerfloom.training.report import write_evaluation

    reference = read_reference(flags)
    loaded = flags.load(found, named, rays_per_pixel=flags.rays_per_pixel, eval_appearance=flags.eval_appearance)
    model, dataset = loaded.model, loaded.dataset(flags.split)
    bound = None if flags.max_error is None else parse_error(flags.max_error)
    with nullcontext() if bound is None else limited_error(model, bound):
        evaluation = evaluate(
            model,
            dataset,
            max_images=flags.max_images,
            pictures=flags.render_output_path,
            max_pictures=flags.max_pictures,
            round_to_uint8=flags.round_to_uint8,
            lpips_weights=flags.lpips_weights or loaded.run.config.lpips_weights,
        )
    say(f"{flags.split}: {evaluation.line()}")
    if evaluation.far_below is not None:
        say(f"  {evaluation.far_below}")
    if bound is not None:
        worst, faster = measured_error(model, dataset, bound)
        say(f"--max-error {bound:.2g}: colours off by at most {worst:.2g} (measured), {faster:.2f} x as fast as exact")
    if flags.eval_appearance in ("half", "nearest") and evaluation.eval_appearance is None:
        asked = flags.eval_appearance
        say(f"--eval-appearance {asked}: this run has one appearance for all images; whole images were evaluated")
    say(f"LPIPS: {evaluation.lpips_note}")
    if evaluation.masks_note is not None:
        say(f"masks: {evaluation.masks_note}")
    geometry: dict[str, Any] | None = None
    wrong = evaluation.pictures_note or evaluation.warning
    if reference is not None:
        try:
            geometry, warning = evaluate_geometry(flags, flags.mesh, loaded, reference)
        except NerfloomError as error:  # what images show is written even so
            warning = str(error)
        wrong = wrong or warning
    write_evaluation(output, loaded.run, loaded.checkpoint, evaluation, model.device, geometry)
    say(f"written to {output}")
    if wrong is not None:
        raise ConfigError(wrong)


def _beside(run: Path) -> Path:
    """Return the default results file for a run's config.yml, a blocks.yml, a file of Gaussians or an octree."""
    is_run = run.suffix == ".yml" and not is_blocks_file(run)
    return run.parent / "eval.json" if is_run else run.with_suffix(".eval.json")


if __name__ == "__main__":
    main()

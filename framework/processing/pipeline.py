"""Creation of a data folder from images: preparation, features, matching, reconstruction, output."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from pathlib import Path

from nerfloom.base.console import say
from nerfloom.base.errors import DataError
from nerfloom.base.json_files import write_json
from nerfloom.processing import colmap, contrast, database, features, mapping, matching, transforms
from nerfloom.processing.images import PreparedImage, prepare_all, write_masks
from nerfloom.processing.output import FINISHED, ready
from nerfloom.processing.parallax import MAX_PAIRS, NO_PARALLAX, WITHOUT, share_that_turned
from nerfloom.processing.pyramid import write_pyramid
from nerfloom.processing.reconstruction import Reconstruction
from nerfloom.processing.summary import Summary, lines

MIN_IMAGES = 3
"""Minimum number of images for a reconstruction."""


def process(state: Reconstruction, folder: Path, sources: list[Path], masks: Path | None) -> None:
    """Estimate the poses of images and write the data folder, after `output.claim` and `unfinished.mark`.

    Args:
        state: the reconstruction.
        folder: folder of the images.
        sources: paths of the images in it, from `find_images`.
        masks: folder of masks, or None.

    Raises:
        DataError: if nothing can be reconstructed; the folder then has no transforms.json.
    """
    flags, output, work = state.flags, state.flags.output_dir, state.work
    with state.timed("preparing"):
        prepared, unreadable = prepare_all(folder, sources, state.images)
        clear = contrast.for_features(folder, prepared, state.images, state.stretched)
        if len(prepared) < MIN_IMAGES:
            raise DataError(f"--data {flags.data}: {len(prepared)} usable images; at least {MIN_IMAGES} are needed")
        mask_of = write_masks(masks, prepared, output / "masks") if masks is not None else {}
    names = [image.name for image in prepared]
    features.extract(state, prepared, clear, output / "masks" if mask_of else None)
    rule = matching.choose_matching(flags.matching_method, len(names), flags.exhaustive_limit, state.ordered)
    with state.timed("matching"):
        pairs = matching.choose_pairs(rule, names, state)
    matching.match(state, pairs, len(names), matching.RULES[rule])
    turned = share_that_turned(database.matches(state.database, MAX_PAIRS))
    if turned >= WITHOUT:
        say(f"warning: {NO_PARALLAX}")
    sizes = mapping.reconstruct(state, names, rule, turned)
    with state.timed("unfolding"):
        sizes = mapping.unfold(state) or sizes

    final = work / "sparse" / "0"
    with state.timed("writing"):
        if flags.undistort:
            state.run(colmap.undistort, (final, state.images, work / "flat"), "Undistorting")
            shutil.move(work / "flat" / "images", output / "images")
            final = work / "flat" / "sparse"
        model: colmap.Model = state.run(colmap.read_model, (final,), "Reading the model")
        frames = _frames(model, prepared, mask_of)
        kept = [frame.name for frame in frames] if flags.undistort else names
        write_pyramid(output / "images", kept, flags.num_downscales)
        write_pyramid(output / "masks", sorted(mask_of.values()), flags.num_downscales if mask_of else 0, masks=True)
        points = model.points @ transforms.Z_UP[:, :3].T
        transforms.write_points(output / transforms.POINTS, points, model.colors)
    summary = Summary(
        images=len(prepared),
        unreadable=len(unreadable),
        registered=len(frames),
        other_models=tuple(sizes[1:]),
        points=len(points),
        reprojection_error=round(model.error, 4),
        matching=rule,
        pairs=database.rows(state.database, "two_view_geometries"),
        turned=turned,
        seconds=state.seconds,
    )
    _keep(work, output / "colmap", final)
    _write_summary(summary, output / "colmap" / "summary.json")
    write_json(output / FINISHED, transforms.content(frames, transforms.Z_UP, transforms.POINTS, {}))
    if flags.mask_moving:
        _mask_moving(state)
    for line in lines(summary):
        say(line)
    say(ready(output))


def _write_summary(summary: Summary, file: Path) -> None:
    seconds = {stage: round(value, 2) for stage, value in summary.seconds.items()}
    file.write_text(json.dumps({**asdict(summary), "seconds": seconds}, indent=2))


def _mask_moving(state: Reconstruction) -> None:
    from nerfloom.processing.moving_masks import mask_moving  # imports all that trains

    with state.timed("masks"):
        mask_moving(state.flags.output_dir, state.flags.num_downscales, max_seconds=state.flags.mask_seconds)


def _frames(model: colmap.Model, prepared: list[PreparedImage], masks: dict[str, str]) -> list[transforms.Frame]:
    lenses = {number: transforms.lens_of(*camera) for number, camera in model.cameras.items()}
    frames = []
    for image in prepared:
        if image.name in model.images:
            number, camera, world_to_camera = model.images[image.name]
            pose = transforms.transformed(transforms.opengl_pose(world_to_camera), transforms.Z_UP)
            mask = masks.get(image.name)
            frames.append(transforms.Frame(image.name, pose, lenses[camera], mask, number, image.source))
    return frames


def _keep(work: Path, target: Path, final: Path) -> None:
    """Move the results out of the working folder, models last, and remove the rest."""
    shutil.move(work / "database.db", target / "database.db")
    models = work / "sparse"
    if final.parent != models:  # the undistorted model belongs to the undistorted images
        shutil.move(models / "0", target / "distorted")
        shutil.move(final, models / "0")
    shutil.move(models, target / "sparse")
    shutil.rmtree(work)

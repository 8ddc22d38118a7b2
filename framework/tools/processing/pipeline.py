"""Creation of a data folder from images: preparation, features, matching, reconstruction, output."""

from __future__ import annotations

import json
import shutil
import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from framework.base.console import say
from framework.base.errors import DataError
from framework.tools.processing import colmap, retrieval, transforms, unfolding
from framework.tools.processing.images import PreparedImage, prepare_all, write_masks
from framework.tools.processing.output import FINISHED, ready
from framework.tools.processing.pyramid import write_pyramid
from framework.tools.processing.settings import ColmapFlags
from framework.tools.processing.summary import Summary, advice, lines
from framework.tools.processing.worker import run_in_child

FEWEST = 3
"""Minimum number of images of a reconstruction."""
ADJACENT = 3
"""Number of next images that retrieval matches with each image, besides similar ones."""
LOOPS = 5
"""Number of similar images that sequential matching matches with each image, to detect loops."""

Seconds = dict[str, float]
"""Seconds spent in each stage."""


def process(
    folder: Path, sources: list[Path], flags: ColmapFlags, masks: Path | None, video: bool, seconds: Seconds
) -> None:
    """Estimate the poses of images and write the data folder `flags.output_dir`, after `output.claim`.

    Args:
        folder: folder of the images.
        sources: paths of the images in it, as `find_images` returns them.
        flags: the user's flags.
        masks: folder of masks, or None.
        video: whether the images are consecutive frames.
        seconds: time spent so far by stage; updated.

    Raises:
        DataError: if nothing can be reconstructed; the folder then has no transforms.json.
    """
    output = flags.output_dir
    work = output / "colmap" / "unfinished"
    work.mkdir(parents=True, exist_ok=True)
    images = work / "images" if flags.undistort else output / "images"
    with _timed(seconds, "preparing"):
        prepared, unreadable = prepare_and_report(folder, sources, images)
        if len(prepared) < FEWEST:
            raise DataError(f"{folder} has {len(prepared)} readable images; at least {FEWEST} are needed")
        mask_of = write_masks(masks, prepared, output / "masks") if masks is not None else {}
    database, log = work / "database.db", None if flags.verbose else output / "colmap" / "log.txt"
    mask_folder = output / "masks" if mask_of else None
    _extract(database, images, prepared, mask_folder, log, flags, seconds)
    matching = _match(database, [image.name for image in prepared], video, log, flags, seconds)
    sizes = _reconstruct(database, images, work / "sparse", len(prepared), matching, log, flags, seconds)
    with _timed(seconds, "unfolding"):
        sizes = _unfold(database, images, work, log, flags) or sizes

    final = work / "sparse" / "0"
    with _timed(seconds, "writing"):
        if flags.undistort:
            run_in_child(colmap.undistort, (final, images, work / "flat"), "Undistorting", 1, log)
            shutil.move(work / "flat" / "images", output / "images")
            final = work / "flat" / "sparse"
        model: colmap.Model = run_in_child(colmap.read_model, (final,), "Reading the model", 1, log)
        frames = _frames(model, prepared, mask_of)
        kept = [frame.name for frame in frames] if flags.undistort else [p.name for p in prepared]
        write_pyramid(output / "images", kept, flags.num_downscales)
        write_pyramid(output / "masks", sorted(mask_of.values()), flags.num_downscales if mask_of else 0, masks=True)
        points = model.points @ transforms.Z_UP[:, :3].T
        transforms.write_points(output / "sparse_pc.ply", points, model.colors)
    summary = Summary(
        images=len(prepared),
        unreadable=len(unreadable),
        registered=len(frames),
        other_models=tuple(sizes[1:]),
        points=len(points),
        reprojection_error=round(model.error, 4),
        matching=matching,
        seconds=seconds,
    )
    _keep(work, output / "colmap", final)
    (output / "colmap" / "summary.json").write_text(json.dumps(summary.as_json(), indent=2))
    transforms.write(output / FINISHED, transforms.content(frames, transforms.Z_UP, "sparse_pc.ply", {}))
    for line in lines(summary):
        say(line)
    say(ready(output))


def prepare_and_report(
    folder: Path, sources: list[Path], images: Path, upright: bool = True, crop: int = 0
) -> tuple[list[PreparedImage], list[str]]:
    """Prepare images (`prepare_all`), and report how many are unreadable and why the first is.

    Args:
        folder: folder of the sources.
        sources: paths of the images in it.
        images: folder to write to.
        upright: whether to undo the EXIF orientation.
        crop: pixels to cut off at each side.

    Returns:
        The prepared images, and the messages for unreadable ones.

    Raises:
        DataError: if no image is readable.
    """
    prepared, unreadable = prepare_all(folder, sources, images, upright, crop)
    if unreadable:
        say(f"{len(unreadable)} of {len(sources)} images are unreadable and skipped, the first: {unreadable[0]}")
    if not prepared:
        raise DataError(f"{folder} has no readable image: {unreadable[0]}")
    return prepared, unreadable


def camera_groups(prepared: list[PreparedImage], sharing: str) -> list[list[str]]:
    """Return the names of images that share a camera, for each camera, in order.

    Args:
        prepared: the prepared images.
        sharing: single: all share one. per-image: none do. auto: those in a folder with equal size, device and focal
            length.

    Raises:
        DataError: if all are to share a camera but differ in size.
    """
    sizes = {(image.width, image.height) for image in prepared}
    if sharing == "single" and len(sizes) > 1:
        few = ", ".join(f"{w}x{h}" for w, h in sorted(sizes)[:3])
        raise DataError(f"--camera-sharing single: the images have {len(sizes)} sizes ({few}); use auto")
    groups: dict[tuple, list[str]] = {}
    for image in prepared:
        alike = (Path(image.name).parent, image.width, image.height, image.device)
        key = {"single": (), "per-image": (image.name,), "auto": alike}[sharing]
        groups.setdefault(key, []).append(image.name)
    return list(groups.values())


def choose_matching(method: str, count: int, exhaustive_limit: int, video: bool) -> str:
    """Return the rule of matching: exhaustive, sequential or retrieval.

    Args:
        method: the user's choice, possibly auto.
        count: number of images.
        exhaustive_limit: maximum number of images of which auto matches all pairs.
        video: whether the images are consecutive frames.
    """
    if method != "auto":
        return method
    if video:
        return "sequential"
    return "exhaustive" if count <= exhaustive_limit else "retrieval"


def choose_pairs(matching: str, names: list[str], database: Path, flags: ColmapFlags) -> list[tuple[str, str]]:
    """Return the pairs of names of images to match.

    Args:
        matching: exhaustive, sequential or retrieval.
        names: names of the images.
        database: COLMAP's database with features.
        flags: the user's flags.
    """
    count = len(names)
    if matching == "exhaustive":
        chosen = retrieval.all_pairs(count)
    else:
        descriptors = retrieval.global_descriptors(retrieval.read_descriptors(database, names))
        sequential = matching == "sequential"
        near = retrieval.sequential_pairs(count, flags.sequential_overlap if sequential else ADJACENT)
        alike = retrieval.similar_pairs(descriptors, LOOPS if sequential else flags.num_neighbors)
        chosen = sorted({*near, *alike})
    return [(names[i], names[j]) for i, j in chosen]


def _extract(
    database: Path,
    images: Path,
    prepared: list[PreparedImage],
    masks: Path | None,
    log: Path | None,
    flags: ColmapFlags,
    seconds: Seconds,
) -> None:
    groups, count = camera_groups(prepared, flags.camera_sharing), len(prepared)
    with _timed(seconds, "features"):
        arguments = (database, images, groups, masks, flags)
        run_in_child(colmap.extract, arguments, "Finding features", count, log, lambda: _rows(database, "descriptors"))
    features = _rows(database, "keypoints", "SUM(rows)")
    cameras = "1 camera" if len(groups) == 1 else f"{len(groups)} cameras"
    say(f"features: {features / count:.0f} per image, {count} images by {cameras}, in {seconds['features']:.1f} s")


def _match(
    database: Path, names: list[str], video: bool, log: Path | None, flags: ColmapFlags, seconds: Seconds
) -> str:
    matching = choose_matching(flags.matching_method, len(names), flags.exhaustive_limit, video)
    with _timed(seconds, "matching"):
        pairs = choose_pairs(matching, names, database, flags)
        arguments = (database, pairs, database.with_name("pairs.txt"), matching == "exhaustive", flags)
        progress = lambda: _rows(database, "two_view_geometries")  # noqa: E731
        run_in_child(colmap.match_pairs, arguments, "Matching", len(pairs), log, progress)
    connected = _rows(database, "two_view_geometries", "SUM(rows > 0)")
    say(f"matching ({matching}): {connected} of {len(pairs)} pairs are connected, in {seconds['matching']:.1f} s")
    return matching


def _reconstruct(
    database: Path,
    images: Path,
    output: Path,
    count: int,
    matching: str,
    log: Path | None,
    flags: ColmapFlags,
    seconds: Seconds,
) -> list[int]:
    with _timed(seconds, "mapping"):
        sizes: list[int] = run_in_child(
            colmap.reconstruct, (database, images, output, flags), "Registering", count, log
        )
    if not sizes:
        raise DataError(f"COLMAP could not register the images: none are connected well enough. {advice(matching)}")
    say(f"mapping: {sizes[0]} of {count} images registered, in {seconds['mapping']:.1f} s")
    return sizes


def _unfold(database: Path, images: Path, work: Path, log: Path | None, flags: ColmapFlags) -> list[int] | None:
    """Replace the models, and the database, by unfolded ones where something that repeats has folded them.

    Returns:
        The number of images of each of the new models; None if nothing was replaced.
    """

    def read(folder: Path) -> colmap.Model:
        model: colmap.Model = run_in_child(colmap.read_model, (folder / "0",), "Reading the model", 1, log)
        return model

    def reconstruct(matches: Path, folder: Path) -> tuple[colmap.Model | None, list[int]]:
        sizes = run_in_child(colmap.reconstruct, (matches, images, folder, flags), "Registering", count, log)
        return (read(folder) if sizes else None), sizes

    model = read(work / "sparse")
    thumbnails, count = unfolding.thumbnails_of(images, model.images), len(model.images)
    found = unfolding.unfold(model, thumbnails, database, work, reconstruct)
    if found is None:
        return None
    shutil.rmtree(work / "sparse")
    shutil.move(found.models, work / "sparse")
    shutil.move(found.database, database)
    return found.sizes


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
    if final.parent != models:  # the undistorted model belongs to the images
        shutil.move(models / "0", target / "distorted")
        shutil.move(final, models / "0")
    shutil.move(models, target / "sparse")
    shutil.rmtree(work)


def _rows(database: Path, table: str, what: str = "COUNT(*)") -> int:
    """Return a number from COLMAP's database, which another process may be writing to; 0 if it is unreadable now."""
    if not database.is_file():
        return 0
    try:
        with closing(sqlite3.connect(f"file:{database.resolve().as_posix()}?mode=ro", uri=True, timeout=0.1)) as opened:
            return int(opened.execute(f"SELECT {what} FROM {table}").fetchone()[0] or 0)
    except sqlite3.Error:
        return 0


@contextmanager
def _timed(seconds: Seconds, stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[stage] = seconds.get(stage, 0.0) + time.perf_counter() - start

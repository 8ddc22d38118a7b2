"""From a folder of photographs to a data folder: prepare, find features, match, reconstruct, write."""

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
from framework.tools.processing import colmap, retrieval, transforms
from framework.tools.processing.output import FINISHED
from framework.tools.processing.photographs import Photograph, prepare_all, write_masks
from framework.tools.processing.pyramid import write_pyramid
from framework.tools.processing.settings import ColmapFlags
from framework.tools.processing.summary import Summary, advice, lines
from framework.tools.processing.worker import run_apart

FEWEST = 3
"""Photographs that a reconstruction needs."""
ADJACENT = 3
"""Next photographs that retrieval compares each one with, besides those that look alike."""
LOOPS = 5
"""Similar photographs that sequential matching compares each one with, to notice a return to a place."""

Seconds = dict[str, float]


def process(
    folder: Path, sources: list[Path], flags: ColmapFlags, masks: Path | None, video: bool, seconds: Seconds
) -> None:
    """Find the poses of photographs and write the data folder `flags.output_dir`, which has been claimed.

    Args:
        folder, sources: the photographs, as `find_photographs` lists them.
        masks: a folder of masks.
        video: they follow each other in time.
        seconds: time spent so far, by stage; added to.
    Raises: DataError where nothing can be reconstructed; the folder has no transforms.json then.
    """
    output = flags.output_dir
    work = output / "colmap" / "unfinished"
    work.mkdir(parents=True, exist_ok=True)
    images = work / "images" if flags.undistort else output / "images"
    with _timed(seconds, "preparing"):
        photographs, unreadable = prepared(folder, sources, images)
        if len(photographs) < FEWEST:
            raise DataError(f"{folder} has {len(photographs)} readable photographs; at least {FEWEST} are needed")
        mask_of = write_masks(masks, photographs, output / "masks") if masks is not None else {}
    database, log = work / "database.db", None if flags.verbose else output / "colmap" / "log.txt"
    mask_folder = output / "masks" if mask_of else None
    _extract(database, images, photographs, mask_folder, log, flags, seconds)
    matching = _match(database, [photograph.name for photograph in photographs], video, log, flags, seconds)
    sizes = _reconstruct(database, images, work / "sparse", len(photographs), matching, log, flags, seconds)

    final = work / "sparse" / "0"
    with _timed(seconds, "writing"):
        if flags.undistort:
            run_apart(colmap.undistort, (final, images, work / "flat"), "Undistorting", 1, log)
            shutil.move(work / "flat" / "images", output / "images")
            final = work / "flat" / "sparse"
        model: colmap.Model = run_apart(colmap.read_model, (final,), "Reading the model", 1, log)
        frames = _frames(model, photographs, mask_of)
        kept = [frame.name for frame in frames] if flags.undistort else [p.name for p in photographs]
        write_pyramid(output / "images", kept, flags.num_downscales)
        write_pyramid(output / "masks", sorted(mask_of.values()), flags.num_downscales if mask_of else 0, masks=True)
        points = model.points @ transforms.Z_UP[:, :3].T
        transforms.write_points(output / "sparse_pc.ply", points, model.colors)
    summary = Summary(
        photographs=len(photographs),
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
    say(f"data folder: {output}")


def prepared(
    folder: Path, sources: list[Path], images: Path, upright: bool = True, crop: int = 0
) -> tuple[list[Photograph], list[str]]:
    """`prepare_all`, and say how many files could not be read and why the first could not."""
    photographs, unreadable = prepare_all(folder, sources, images, upright, crop)
    if unreadable:
        say(f"{len(unreadable)} of {len(sources)} images are unreadable and skipped, the first: {unreadable[0]}")
    if not photographs:
        raise DataError(f"{folder} has no readable image: {unreadable[0]}")
    return photographs, unreadable


def camera_groups(photographs: list[Photograph], sharing: str) -> list[list[str]]:
    """Names of the photographs that share a camera, in their order.

    Args:
        sharing: single: all of them. per-image: none do. auto: those of a folder, of equal size, device and focal
            length.
    Raises: DataError where all shall share a camera but differ in size.
    """
    sizes = {(photograph.width, photograph.height) for photograph in photographs}
    if sharing == "single" and len(sizes) > 1:
        few = ", ".join(f"{w}x{h}" for w, h in sorted(sizes)[:3])
        raise DataError(f"--camera-sharing single: the photographs have {len(sizes)} sizes ({few}); use auto")
    groups: dict[tuple, list[str]] = {}
    for photograph in photographs:
        alike = (Path(photograph.name).parent, photograph.width, photograph.height, photograph.device)
        key = {"single": (), "per-image": (photograph.name,), "auto": alike}[sharing]
        groups.setdefault(key, []).append(photograph.name)
    return list(groups.values())


def choose_matching(method: str, count: int, exhaustive_limit: int, video: bool) -> str:
    """What auto means: exhaustive, sequential or retrieval."""
    if method != "auto":
        return method
    if video:
        return "sequential"
    return "exhaustive" if count <= exhaustive_limit else "retrieval"


def choose_pairs(matching: str, names: list[str], database: Path, flags: ColmapFlags) -> list[tuple[str, str]]:
    """The pairs of photographs to compare."""
    count = len(names)
    if matching == "exhaustive":
        chosen = retrieval.all_pairs(count)
    else:
        looks = retrieval.looks_of(retrieval.read_descriptors(database, names))
        sequential = matching == "sequential"
        near = retrieval.sequential_pairs(count, flags.sequential_overlap if sequential else ADJACENT)
        alike = retrieval.similar_pairs(looks, LOOPS if sequential else flags.num_neighbors)
        chosen = sorted({*near, *alike})
    return [(names[i], names[j]) for i, j in chosen]


def _extract(
    database: Path,
    images: Path,
    photographs: list[Photograph],
    masks: Path | None,
    log: Path | None,
    flags: ColmapFlags,
    seconds: Seconds,
) -> None:
    groups, count = camera_groups(photographs, flags.camera_sharing), len(photographs)
    with _timed(seconds, "features"):
        arguments = (database, images, groups, masks, flags)
        run_apart(colmap.extract, arguments, "Finding features", count, log, lambda: _rows(database, "descriptors"))
    found = _rows(database, "keypoints", "SUM(rows)")
    cameras = "1 camera" if len(groups) == 1 else f"{len(groups)} cameras"
    say(f"features: {found / count:.0f} a photograph, of {count} by {cameras}, in {seconds['features']:.1f} s")


def _match(
    database: Path, names: list[str], video: bool, log: Path | None, flags: ColmapFlags, seconds: Seconds
) -> str:
    matching = choose_matching(flags.matching_method, len(names), flags.exhaustive_limit, video)
    with _timed(seconds, "matching"):
        pairs = choose_pairs(matching, names, database, flags)
        arguments = (database, pairs, database.with_name("pairs.txt"), matching == "exhaustive", flags)
        done = lambda: _rows(database, "two_view_geometries")  # noqa: E731
        run_apart(colmap.match_pairs, arguments, "Matching", len(pairs), log, done)
    connected = _rows(database, "two_view_geometries", "SUM(rows > 0)")
    say(f"matching ({matching}): {connected} of {len(pairs)} pairs connect, in {seconds['matching']:.1f} s")
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
        sizes: list[int] = run_apart(colmap.reconstruct, (database, images, output, flags), "Placing", count, log)
    if not sizes:
        raise DataError(f"COLMAP could not place the photographs: none connect well enough. {advice(matching)}")
    say(f"mapping: {sizes[0]} of {count} photographs placed, in {seconds['mapping']:.1f} s")
    return sizes


def _frames(model: colmap.Model, photographs: list[Photograph], masks: dict[str, str]) -> list[transforms.Frame]:
    lenses = {number: transforms.lens_of(*camera) for number, camera in model.cameras.items()}
    frames = []
    for photograph in photographs:
        if photograph.name in model.images:
            number, camera, world_to_camera = model.images[photograph.name]
            pose = transforms.transformed(transforms.opengl_pose(world_to_camera), transforms.Z_UP)
            mask = masks.get(photograph.name)
            frames.append(transforms.Frame(photograph.name, pose, lenses[camera], mask, number, photograph.source))
    return frames


def _keep(work: Path, target: Path, final: Path) -> None:
    """Move what is worth keeping out of the working folder, the models last, and remove the rest."""
    shutil.move(work / "database.db", target / "database.db")
    models = work / "sparse"
    if final.parent != models:  # undistorted: that model is the one that goes with the images
        shutil.move(models / "0", target / "distorted")
        shutil.move(final, models / "0")
    shutil.move(models, target / "sparse")
    shutil.rmtree(work)


def _rows(database: Path, table: str, what: str = "COUNT(*)") -> int:
    """A figure out of COLMAP's database while it may be written to; 0 where it cannot be read at the moment."""
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

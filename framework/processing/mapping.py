"""Estimation of poses from matches by COLMAP, with more matches if only few pairs were matched and images remain."""

from __future__ import annotations

import shutil
import statistics
from pathlib import Path

from nerfloom.base.console import say
from nerfloom.base.errors import DataError
from nerfloom.processing import colmap, database, unfolding
from nerfloom.processing.job import Job
from nerfloom.processing.matching import match, pairs_of
from nerfloom.processing.parallax import NO_PARALLAX, WITHOUT
from nerfloom.processing.summary import advice

MIN_FEATURES = 15
"""Minimum number of features of an image that can be placed: COLMAP's minimum number of matches."""
FEW_FEATURES = 100
"""An image with fewer features is probably dark, blurred or without texture."""


def reconstruct(job: Job, names: list[str], matching: str, turned: float) -> list[int]:
    """Reconstruct, and write the models to sparse/0, sparse/1, ... in the job's folder, largest first.

    If `auto` matched few pairs, the unregistered images are matched with more images. The result with more registered
    images is kept.

    Args:
        job: the reconstruction, with matches.
        names: names of all images.
        matching: the rule for selecting pairs.
        turned: fraction of image pairs between which the camera only rotated; if it is large, more pairs cannot help.

    Returns:
        The number of registered images of each model.

    Raises:
        DataError: if there is no model, with the reason if known.
    """
    sizes = _map(job, job.work / "sparse", len(names))
    if not sizes and turned >= WITHOUT:
        raise DataError(f"COLMAP could not register the images: {NO_PARALLAX}")
    if matching == "sequential" and turned < WITHOUT and job.flags.matching_method == "auto":
        sizes = _with_more_pairs(job, names, sizes)
    if not sizes:
        raise DataError(f"COLMAP could not register the images: {_reason(job)}. {advice(matching)}")
    return sizes


def unfold(job: Job) -> list[int] | None:
    """Replace folded models, and the database, by unfolded ones, if repeated patterns have folded them.

    Args:
        job: the reconstruction, with models.

    Returns:
        The number of images of each new model; None if nothing was replaced.
    """

    def read(folder: Path) -> colmap.Model:
        model: colmap.Model = job.run(colmap.read_model, (folder / "0",), "Reading the model")
        return model

    def reconstruct_from(matches: Path, folder: Path) -> tuple[colmap.Model | None, list[int]]:
        sizes = job.run(colmap.reconstruct, (matches, job.images, folder, job.flags), "Registering", count)
        return (read(folder) if sizes else None), sizes

    model = read(job.work / "sparse")
    thumbnails, count = unfolding.thumbnails_of(job.images, model.images), len(model.images)
    found = unfolding.unfold(model, thumbnails, job.database, job.work, reconstruct_from)
    if found is None:
        return None
    shutil.rmtree(job.work / "sparse")
    shutil.move(found.models, job.work / "sparse")
    shutil.move(found.database, job.database)
    return found.sizes


def _map(job: Job, folder: Path, count: int) -> list[int]:
    with job.timed("mapping"):
        arguments = (job.database, job.images, folder, job.flags)
        sizes: list[int] = job.run(colmap.reconstruct, arguments, "Registering", count)
    say(f"mapping: {sizes[0] if sizes else 0} of {count} images registered, in {job.seconds['mapping']:.1f} s")
    return sizes


def _with_more_pairs(job: Job, names: list[str], sizes: list[int]) -> list[int]:
    """Match unregistered images with more images and reconstruct again; return the sizes of the better models."""
    first, again = job.work / "sparse", job.work / "again"
    placed = job.run(colmap.read_model, (first / "0",), "Reading the model").images if sizes else {}
    features = database.features(job.database)
    left = [name for name in names if name not in placed and features.get(name, 0) >= MIN_FEATURES]
    pairs = pairs_of(left, names, job)
    known, connected = database.pairs(job.database), database.connected(job.database)
    if known.issuperset(pairs):
        return sizes
    few = f"{left[0]}{', ...' if len(left) > 1 else ''}"
    match(job, pairs, len(names), f"{len(left)} images are unregistered ({few}) and are matched with more images")
    if database.connected(job.database) == connected:
        return sizes
    found = _map(job, again, len(names))
    if not found or (sizes and found[0] <= sizes[0]):
        return sizes
    shutil.rmtree(first, ignore_errors=True)
    shutil.move(again, first)
    return found


def _reason(job: Job) -> str:
    """Return the reason why images could not be registered, from their features and matches."""
    found = database.features(job.database).values()
    middle = statistics.median(found) if found else 0.0
    dark = ", and some are dark or foggy (see above): take photographs in more light" if job.stretched.is_dir() else ""
    if middle < FEW_FEATURES:
        return f"they have few features, {middle:.0f} on average; they may be blurred, dark or blank{dark}"
    if not database.connected(job.database):
        return f"no two of them match{dark}"
    return f"none are connected well enough{dark}"

"""Estimation of poses from matches by COLMAP, with more matches if only few pairs were matched and images remain."""

from __future__ import annotations

import shutil
import statistics
from pathlib import Path

from nerfloom.base.console import say
from nerfloom.base.errors import DataError
from nerfloom.processing import colmap, database, unfolding
from nerfloom.processing.matching import match, pairs_of
from nerfloom.processing.parallax import NO_PARALLAX, WITHOUT
from nerfloom.processing.reconstruction import Reconstruction
from nerfloom.processing.summary import advice

MIN_FEATURES = 15
"""Minimum number of features of an image that can be placed: COLMAP's minimum number of matches."""
FEW_FEATURES = 100
"""An image with fewer features is probably dark, blurred or without texture."""


def reconstruct(state: Reconstruction, names: list[str], matching: str, turned: float) -> list[int]:
    """Reconstruct, and write the models to sparse/0, sparse/1, ... in its folder, largest first.

    If `auto` matched few pairs, the unregistered images are matched with more images. The result with more registered
    images is kept.

    Args:
        state: the reconstruction, with matches.
        names: names of all images.
        matching: the rule for selecting pairs.
        turned: fraction of image pairs with a camera that only rotated; if it is large, more pairs cannot help.

    Returns:
        The number of registered images of each model.

    Raises:
        DataError: if there is no model, with the reason if known.
    """
    sizes = _map(state, state.work / "sparse", len(names))
    if not sizes and turned >= WITHOUT:
        raise DataError(f"COLMAP could not register the images: {NO_PARALLAX}")
    if matching == "sequential" and turned < WITHOUT and state.flags.matching_method == "auto":
        sizes = _with_more_pairs(state, names, sizes)
    if not sizes:
        raise DataError(f"COLMAP could not register the images: {_reason(state)}. {advice(matching)}")
    return sizes


def unfold(state: Reconstruction) -> list[int] | None:
    """Replace folded models, and the database, by unfolded ones, if repeated patterns have folded them.

    Args:
        state: the reconstruction, with models.

    Returns:
        The number of images of each new model; None if nothing was replaced.
    """

    def read(folder: Path) -> colmap.Model:
        model: colmap.Model = state.run(colmap.read_model, (folder / "0",), "Reading the model")
        return model

    def reconstruct_from(matches: Path, folder: Path) -> tuple[colmap.Model | None, list[int]]:
        sizes = state.run(colmap.reconstruct, (matches, state.images, folder, state.flags), "Registering", count)
        return (read(folder) if sizes else None), sizes

    model = read(state.work / "sparse")
    thumbnails, count = unfolding.thumbnails_of(state.images, model.images), len(model.images)
    found = unfolding.unfold(model, thumbnails, state.database, state.work, reconstruct_from)
    if found is None:
        return None
    shutil.rmtree(state.work / "sparse")
    shutil.move(found.models, state.work / "sparse")
    shutil.move(found.database, state.database)
    return found.sizes


def _map(state: Reconstruction, folder: Path, count: int) -> list[int]:
    with state.timed("mapping"):
        arguments = (state.database, state.images, folder, state.flags)
        sizes: list[int] = state.run(colmap.reconstruct, arguments, "Registering", count)
    say(f"mapping: {sizes[0] if sizes else 0} of {count} images registered, in {state.seconds['mapping']:.1f} s")
    return sizes


def _with_more_pairs(state: Reconstruction, names: list[str], sizes: list[int]) -> list[int]:
    """Match unregistered images with more images and reconstruct again; return the sizes of the better models."""
    first, again = state.work / "sparse", state.work / "again"
    placed = state.run(colmap.read_model, (first / "0",), "Reading the model").images if sizes else {}
    features = database.features(state.database)
    left = [name for name in names if name not in placed and features.get(name, 0) >= MIN_FEATURES]
    pairs = pairs_of(left, names, state)
    known, connected = database.pairs(state.database), database.connected(state.database)
    if known.issuperset(pairs):
        return sizes
    few = f"{left[0]}{', ...' if len(left) > 1 else ''}"
    match(state, pairs, len(names), f"{len(left)} images are unregistered ({few}) and are matched with more images")
    if database.connected(state.database) == connected:
        return sizes
    found = _map(state, again, len(names))
    if not found or (sizes and found[0] <= sizes[0]):
        return sizes
    shutil.rmtree(first, ignore_errors=True)
    shutil.move(again, first)
    return found


def _reason(state: Reconstruction) -> str:
    """Return the reason why images could not be registered, from their features and matches."""
    found = database.features(state.database).values()
    middle = statistics.median(found) if found else 0.0
    dark = (
        ", and some are dark or foggy (see above): take photographs in more light" if state.stretched.is_dir() else ""
    )
    if middle < FEW_FEATURES:
        return f"they have few features, {middle:.0f} on average; they may be blurred, dark or blank{dark}"
    if not database.connected(state.database):
        return f"no two of them match{dark}"
    return f"none are connected well enough{dark}"

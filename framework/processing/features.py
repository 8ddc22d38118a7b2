"""Extraction of features by COLMAP, for images that are not in its database yet."""

from __future__ import annotations

from pathlib import Path

from nerfloom.base.console import say
from nerfloom.base.errors import DataError
from nerfloom.processing import colmap, database
from nerfloom.processing.images import PreparedImage
from nerfloom.processing.panoramas import camera_parameters
from nerfloom.processing.reconstruction import Reconstruction
from nerfloom.processing.settings import ColmapFlags


def camera_groups(prepared: list[PreparedImage], sharing: str) -> list[list[str]]:
    """Return the names of images that share a camera, for each camera, in order.

    Args:
        prepared: the prepared images.
        sharing: single: all images share one camera. per-image: each has its own. auto: images in a folder with equal
            size, device and focal length share one.

    Raises:
        DataError: if all images share a camera but differ in size.
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


def extract(state: Reconstruction, prepared: list[PreparedImage], images: Path, masks: Path | None) -> None:
    """Extract features.

    Args:
        state: the reconstruction.
        prepared: the prepared images.
        images: folder of the images for feature extraction.
        masks: folder of masks, or None.
    """
    groups = camera_groups(prepared, state.flags.camera_sharing)
    known = database.features(state.database)
    cameras = [database.camera_of(state.database, group) for group in groups]
    widths = {image.name: image.width for image in prepared}
    missing = [
        ([name for name in group if name not in known], camera, _parameters(state.flags, widths[group[0]]))
        for group, camera in zip(groups, cameras, strict=True)
    ]
    count = sum(len(names) for names, _, _ in missing)
    if count:
        with state.timed("features"):
            arguments = (state.database, images, [entry for entry in missing if entry[0]], masks, state.flags)
            extracted = lambda: database.rows(state.database, "descriptors") - len(known)  # noqa: E731
            state.run(colmap.extract, arguments, "Finding features", count, extracted, "images")
    found = database.features(state.database)
    mean = sum(found.values()) / max(len(found), 1)
    by = "1 camera" if len(groups) == 1 else f"{len(groups)} cameras"
    kept = f", {len(known)} reused" if known else ""
    say(
        f"features: {mean:.0f} per image, {len(prepared)} images by {by}{kept}, "
        f"in {state.seconds.get('features', 0.0):.1f} s"
    )


def _parameters(flags: ColmapFlags, width: int) -> str:
    """Return COLMAP's parameters of a camera with a known lens, such as of views; "" otherwise."""
    return "" if flags.camera_type == "perspective" else camera_parameters(width, flags.view_angle)

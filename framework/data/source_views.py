"""Choice of source images for rendering a view: images of the same scene that look in the most similar directions."""

from __future__ import annotations

from torch import Tensor

from nerfloom.data.dataset import Dataset


def images_of(dataset: Dataset, scene: int | None) -> Tensor:
    """Return the indices (K,) int64, on the CPU, of a scene's source images, which other images may be rendered from.

    Args:
        dataset: images of one scene or of several.
        scene: index of the scene; None for the first.

    Returns:
        The source images of the scene; all of its images if none is declared, and no images for an unknown scene.
        Images with a pose that is not finite are left out, because they would spoil everything rendered from them.
    """
    found = dataset.cameras.camera_to_worlds.isfinite().flatten(1).all(-1).cpu()
    if dataset.scene_indices is not None:
        found &= dataset.scene_indices == (dataset.scene_indices[0] if scene is None else scene)
    if dataset.source_images is not None:
        found &= dataset.source_images
    return found.nonzero()[:, 0]


def other_images(dataset: Dataset, images: Tensor, pose: Tensor) -> Tensor:
    """Return `images` (K,), on the CPU, without the images at `pose` (3, 4) in `dataset`."""
    same = (dataset.cameras.camera_to_worlds == pose).flatten(1).all(-1).cpu()
    return images[~same[images]]


def nearest_in_direction(dataset: Dataset, images: Tensor, pose: Tensor, count: int) -> Tensor:
    """Return `count` of `images` (K,) of `dataset` that look most like `pose` (3, 4), most similar first."""
    likeness = (dataset.cameras.camera_to_worlds[:, :, 2] * pose[:, 2]).sum(-1).cpu()
    return images[likeness[images].argsort(descending=True, stable=True)[:count]]

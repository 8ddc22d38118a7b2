"""COLMAP scenes: a sparse reconstruction beside the folder of images (Schönberger and Frahm 2016)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePath

from torch import Tensor

from nerfloom import DataError, ParsedScene
from nerfloom.base.splits import Split
from nerfloom.data.names_on_disk import has_images, on_disk
from nerfloom.data.tracks import Tracks, doubts_about
from nerfloom.dataparsers.captured import captured_scene, has_transforms
from nerfloom.dataparsers.colmap_lens import lenses_of
from nerfloom.dataparsers.colmap_model import SparseModel, choose_model, find_models, read_model
from nerfloom.dataparsers.masks import find_masks
from nerfloom.dataparsers.posed_images import Captured, PosedImages


@dataclass(frozen=True)
class Colmap(Captured):
    """Flags of the colmap format."""

    colmap_path: str | None = None
    """Folder of the reconstruction in the data folder. Default: the one with the most images in sparse or
    colmap/sparse."""
    images_path: str = "images"
    """Folder of the images in the data folder; reduced images are in folders beside it, such as images_2."""
    masks_path: str = "masks"
    """Folder of masks in the data folder: white for pixels to train on."""

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        # Collections of the phototourism format have their reconstruction in dense/sparse, which is not searched here.
        models = find_models(path)
        # A model alone, such as sparse/0 itself, is not a data folder: its images are elsewhere.
        return bool(models) and (models != [path / "."] or has_images(path)) and not has_transforms(path)

    def parse(self, path: Path | None, split: Split) -> ParsedScene:
        if path is None:
            raise DataError("the colmap format needs a folder: --data DIR")
        model = choose_model(path, self.colmap_path, self.images_path, quiet=split != "train")
        return captured_scene(self, read_images(path, model, self.images_path, self.masks_path, split), split)


def read_images(path: Path, model: Path, images: str, masks: str, split: Split) -> PosedImages:
    """Read all registered images of a reconstruction, sorted by name.

    Args:
        path: the data folder.
        model: folder of the reconstruction.
        images: folder of the images in `path`.
        masks: folder of the masks in `path`.
        split: the split to read; for training, differences between names and the disk are reported.

    Raises:
        DataError: as `read_model`, or for an unsupported camera model.
    """
    sparse = read_model(model)
    optics = lenses_of(sparse.cameras, sparse.names, str(model))
    paths = on_disk(path, [f"{images}/{name}" for name in sparse.names], quiet=split != "train")
    inside = [file.relative_to(path / images) if file.is_relative_to(path / images) else file.name for file in paths]
    return PosedImages(
        folder=path,
        paths=paths,
        names=sparse.names,
        poses=sparse.poses,
        intrinsics=optics.intrinsics,
        sizes=optics.sizes,
        model=optics.model,
        lens=optics.lens,
        masks=find_masks(path / masks, [PurePath(name).as_posix() for name in inside]),
        tracks=tracks_of(sparse, optics.intrinsics),
    )


def tracks_of(sparse: SparseModel, intrinsics: Tensor) -> Tracks | None:
    """Return the tracks of `sparse` in its own frame, by (M, 4) `intrinsics` of its images; None without points."""
    if not len(sparse.points):
        return None
    images, seen = sparse.sightings.unbind(-1)
    angles = sparse.errors[seen] / intrinsics[images, :2].mean(-1)
    return Tracks(sparse.points, images, seen, angles, doubts_about(sparse.lengths, sparse.errors))

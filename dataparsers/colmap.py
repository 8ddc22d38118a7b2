"""COLMAP scenes: a sparse reconstruction beside the folder of photographs (Schönberger and Frahm 2016)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dataparsers.captured import Captured, Photographs, captured_scene, has_transforms
from dataparsers.colmap_lens import lenses_of
from dataparsers.colmap_model import choose_model, find_models, read_model
from dataparsers.masks import find_masks
from framework import DataError, ParsedScene
from framework.data.dataset import Split


@dataclass(frozen=True)
class Colmap(Captured):
    """Flags of the colmap format."""

    colmap_path: str | None = None
    """Where the reconstruction is, below the data folder; by default the one with the most images in sparse or
    colmap/sparse."""
    images_path: str = "images"
    """Where the photographs are, below the data folder; reduced ones are beside it, as in images_2."""
    masks_path: str = "masks"
    """Where masks are, below the data folder: white where a photograph is to be learnt from."""

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        # An internet collection (phototourism) has its reconstruction in dense/sparse, which is not looked at here.
        return bool(find_models(path)) and not has_transforms(path)

    def parse(self, path: Path | None, split: Split) -> ParsedScene:
        if path is None:
            raise DataError("the colmap format needs a folder: --data DIR")
        model = choose_model(path, self.colmap_path)
        return captured_scene(self, read_photographs(path, model, self.images_path, self.masks_path), split)


def read_photographs(path: Path, model: Path, images: str, masks: str) -> Photographs:
    """All registered images of a reconstruction, by sorted name.

    Args:
        path: the data folder.
        model: the folder of the reconstruction.
        images, masks: folders below `path`.
    Raises: DataError as `read_model` does, and for a camera model that is not known.
    """
    sparse = read_model(model)
    optics = lenses_of(sparse.cameras, sparse.names, str(model))
    return Photographs(
        folder=path,
        paths=tuple(path / images / name for name in sparse.names),
        names=sparse.names,
        poses=sparse.poses,
        intrinsics=optics.intrinsics,
        sizes=optics.sizes,
        model=optics.model,
        lens=optics.lens,
        masks=find_masks(path / masks, sparse.names),
        points=sparse.points if len(sparse.points) else None,
    )

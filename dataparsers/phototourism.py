"""Phototourism collections: images of a landmark by many people, with splits in a .tsv (Jin et al. 2020).

NeRF in the Wild (Martin-Brualla et al. 2021) lists its training images in such a file, with the columns `filename`,
`id`, `split` and `dataset`; images without `id` have no pose.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from nerfloom import DataError, ParsedScene
from nerfloom.base.splits import Split
from nerfloom.data.names_on_disk import spelled
from nerfloom.dataparsers.captured import captured_scene, has_transforms
from nerfloom.dataparsers.colmap import read_images
from nerfloom.dataparsers.colmap_model import choose_model, find_models
from nerfloom.dataparsers.posed_images import Captured

SPARSE = "dense/sparse"
"""Folder of the reconstruction in the data folder."""


@dataclass(frozen=True)
class Phototourism(Captured):
    """Flags of the phototourism format."""

    colmap_path: str = SPARSE
    """Folder of the reconstruction in the data folder."""
    images_path: str = "dense/images"
    """Folder of the images in the data folder."""
    masks_path: str = "dense/masks"
    """Folder of masks in the data folder: white for pixels to train on."""

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        is_other_format = has_transforms(path) or find_models(path)
        return bool(_tables(path)) and bool(find_models(path, (SPARSE,))) and not is_other_format

    def parse(self, path: Path | None, split: Split) -> ParsedScene:
        if path is None:
            raise DataError("the phototourism format needs a folder: --data DIR")
        tables = _tables(path)
        if len(tables) != 1:
            problem = f"there are {', '.join(file.name for file in tables)}" if tables else "there is none"
            raise DataError(f"{path}: the splits must be listed in one .tsv, but {problem}")
        splits = {spelled(name): of for name, of in read_splits(tables[0]).items()}
        model = choose_model(path, self.colmap_path, self.images_path, quiet=split != "train")
        images = read_images(path, model, self.images_path, self.masks_path, split)
        listed = [index for index, name in enumerate(images.names) if spelled(name) in splits]
        if not listed:
            raise DataError(
                f"{tables[0]} lists none of the {len(images.names)} images of {model}; it must have their names, such "
                f"as {images.names[0]}"
            )
        group = "train" if split == "train" else "test"

        def division(names: list[str]) -> Tensor:
            chosen = [index for index, name in enumerate(names) if splits[spelled(name)] == group]
            if not chosen:
                raise DataError(f"{tables[0]}: none of the {len(names)} existing images is of split '{group}'")
            return torch.tensor(chosen)

        scene = captured_scene(self, images[torch.tensor(listed)], split, division)
        return replace(scene, appearance_varies=True)


def _tables(path: Path) -> list[Path]:
    """Return the .tsv files of a folder. Never raises."""
    try:
        return sorted(path.glob("*.tsv"))
    except OSError:
        return []


def read_splits(file: Path) -> dict[str, str]:
    """Return file name -> train or test, for the images of a .tsv `file` with a pose.

    Raises:
        DataError: if the file cannot be read, lacks a column, or has an unknown split.
    """
    try:
        with file.open(encoding="utf-8-sig", newline="") as handle:
            rows = list(csv.DictReader(handle, delimiter="\t"))
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror}") from error
    except (ValueError, csv.Error) as error:
        raise DataError(f"{file} is not a tab-separated table: {error}") from error
    splits: dict[str, str] = {}
    for line, row in enumerate(rows, start=2):
        name, number, split = row.get("filename"), row.get("id"), row.get("split")
        if not name or number is None or split is None:
            raise DataError(f"{file}: line {line} lacks one of the columns filename, id and split")
        if number.strip() and split not in ("train", "test"):
            raise DataError(f"{file}: line {line}: the split is {split!r}; it must be train or test")
        if number.strip():
            splits[name] = split
    return splits

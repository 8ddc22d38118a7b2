"""Phototourism collections: photographs of a landmark by many people, split by a .tsv (Jin et al. 2020).

NeRF in the Wild (Martin-Brualla et al. 2021) states which photographs it learnt from in such a file: a line each with
`filename`, `id`, `split` and `dataset`; those without `id` have no pose.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from dataparsers.captured import Captured, captured_scene, has_transforms
from dataparsers.colmap import read_photographs
from dataparsers.colmap_model import choose_model, find_models
from framework import DataError, ParsedScene
from framework.data.dataset import Split

SPARSE = "dense/sparse"


@dataclass(frozen=True)
class Phototourism(Captured):
    """Flags of the phototourism format."""

    colmap_path: str = SPARSE
    """Where the reconstruction is, below the data folder."""
    images_path: str = "dense/images"
    """Where the photographs are, below the data folder."""
    masks_path: str = "dense/masks"
    """Where masks are, below the data folder: white where a photograph is to be learnt from."""

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        others = has_transforms(path) or find_models(path)
        return bool(_tables(path)) and bool(find_models(path, (SPARSE,))) and not others

    def parse(self, path: Path | None, split: Split) -> ParsedScene:
        if path is None:
            raise DataError("the phototourism format needs a folder: --data DIR")
        tables = _tables(path)
        if len(tables) != 1:
            found = f"{', '.join(file.name for file in tables)} are there" if tables else "there is none"
            raise DataError(f"{path}: one .tsv says which photographs are in which split, but {found}")
        splits = read_splits(tables[0])
        model = choose_model(path, self.colmap_path)
        photographs = read_photographs(path, model, self.images_path, self.masks_path)
        listed = [index for index, name in enumerate(photographs.names) if name in splits]
        if not listed:
            raise DataError(f"{tables[0]} lists none of the {len(photographs.names)} images of {model}")
        wanted = "train" if split == "train" else "test"

        def division(names: list[str]) -> Tensor:
            chosen = [index for index, name in enumerate(names) if splits[name] == wanted]
            if not chosen:
                raise DataError(f"{tables[0]}: none of the {len(names)} images that are there is of split '{wanted}'")
            return torch.tensor(chosen)

        scene = captured_scene(self, photographs[torch.tensor(listed)], split, division)
        return replace(scene, appearance_varies=True)


def _tables(path: Path) -> list[Path]:
    """The .tsv files of a folder. Never raises."""
    try:
        return sorted(path.glob("*.tsv"))
    except OSError:
        return []


def read_splits(file: Path) -> dict[str, str]:
    """File name to train or test, of the photographs with a pose.

    Raises: DataError where the file cannot be read, lacks a column, or names another split.
    """
    try:
        with file.open(encoding="utf-8", newline="") as handle:
            rows = list(csv.DictReader(handle, delimiter="\t"))
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror}") from error
    except (ValueError, csv.Error) as error:
        raise DataError(f"{file} is not a table of columns between tabs: {error}") from error
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

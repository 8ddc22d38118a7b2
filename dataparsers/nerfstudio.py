"""Captures in nerfstudio's and instant-ngp's format: one transforms.json with poses and intrinsics."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import torch
from torch import Tensor

from nerfloom import DataError, ParsedScene
from nerfloom.base.console import say
from nerfloom.base.errors import shown
from nerfloom.base.evenly_spaced import evenly_spaced
from nerfloom.base.json_files import number, read_object
from nerfloom.base.splits import Split
from nerfloom.cameras.poses import Orientation
from nerfloom.data.depths import DEPTH_SUFFIXES
from nerfloom.data.exposure import Taken
from nerfloom.data.names_on_disk import nearest_on_disk, on_disk, spelled
from nerfloom.data.ply import read_points
from nerfloom.data.suffixes import IMAGE_SUFFIXES
from nerfloom.data.tracks import Tracks
from nerfloom.dataparsers.captured import Division, captured_scene, checked_box, image_sizes
from nerfloom.dataparsers.colmap_beside import names_in_model, tracks_beside
from nerfloom.dataparsers.companions import companions
from nerfloom.dataparsers.intrinsics import ngp_cube, read_intrinsics
from nerfloom.dataparsers.placing import from_original
from nerfloom.dataparsers.posed_images import Captured, PosedImages
from nerfloom.dataparsers.reading import Frames, file_name, read_frames, read_pose, read_times, rigid

TRANSFORMS = "transforms.json"
"""File that identifies the format."""
EvalMode = Literal["interval", "fraction", "filename", "all"]
"""Rule for held-out images."""
STATED_ORIENTATIONS = ("none", "up", "pca")
"""Values of `orientation_override`, nerfstudio's entry, that are known here."""
EXPOSURE = ("exposure_time", "f_number", "iso")
"""Entries of a frame, or of the file for all frames, that state its exposure; the time is in seconds."""
MILLIMETRE = 0.001
"""Default units of the input per unit of a stored depth, as in nerfstudio."""


@dataclass(frozen=True)
class Nerfstudio(Captured):
    """Flags of the nerfstudio format."""

    eval_mode: EvalMode = "interval"
    """Rule for held-out images. interval: every --eval-interval-th. fraction: all but --train-split-fraction. filename:
    images with eval, val or test in their name. all: none, every split has all images. The file's own train_filenames,
    val_filenames and test_filenames take precedence over all rules but the last."""
    train_split_fraction: float = 0.9
    """Fraction of images to train on, evenly spaced, with --eval-mode fraction."""
    depth_unit_scale_factor: float = MILLIMETRE
    """Units of the input per unit of a stored depth: 0.001 for an input in metres and depths in millimetres."""

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return (path / TRANSFORMS).is_file() and not (path / "transforms_train.json").is_file()

    def parse(self, path: Path | None, split: Split) -> ParsedScene:
        if path is None:
            raise DataError("the nerfstudio format needs a folder: --data DIR")
        if not 0 < self.train_split_fraction <= 1:
            raise DataError(f"--train-split-fraction is {self.train_split_fraction}; it must be above 0, at most 1")
        if not 0 < self.depth_unit_scale_factor < math.inf:
            raise DataError(f"--depth-unit-scale-factor is {self.depth_unit_scale_factor}; it must be above zero")
        file = path if path.suffix == ".json" else path / TRANSFORMS
        content = read_object(file)
        images = _posed_images(file, content, split)
        if split == "train" and self.depth_unit_scale_factor == MILLIMETRE and _may_be_metres(images.depths):
            say("depths are read as millimetres; use --depth-unit-scale-factor 1 if they are in metres")
        lists = {} if self.eval_mode == "all" else _lists(file, content, images.names)
        stated = self._stated_orientation(content)
        flags = self if stated is None else replace(self, orientation_method=stated)
        scene = captured_scene(flags, images, split, self._division(split, lists), _applied(content, file))
        z_is_up = scene.z_is_up or stated is not None
        scene = replace(scene, depth_unit=self.depth_unit_scale_factor, z_is_up=z_is_up)
        return _from_original(_with_cube(scene, content, file, self.scene_scale), content, file)

    def _stated_orientation(self, content: dict[str, Any]) -> Orientation | None:
        """Return the up direction that the file states, if it is left to the data; else None.

        Devices and other programs know which way is up, also where cameras look straight down.
        """
        stated: Any = content.get("orientation_override")
        return stated if self.orientation_method == "auto" and stated in STATED_ORIENTATIONS else None

    def _division(self, split: Split, lists: dict[str, set[str]]) -> Division | None:
        if lists:
            return lambda names: _listed(names, split, lists)
        if self.eval_mode == "fraction":
            return lambda names: _fraction(names, split, self.train_split_fraction)
        if self.eval_mode == "filename":
            return lambda names: _by_name(names, split)
        if self.eval_mode == "all":
            return _sorted
        return None


def _posed_images(file: Path, content: dict[str, Any], split: Split) -> PosedImages:
    frames = read_frames(content, file, "file_path")
    written = [file_name(frame.get("file_path"), "file_path", label) for frame, label in frames]
    paths = on_disk(file.parent, written, quiet=split != "train")
    lenses = read_intrinsics(file, content, frames, lambda: image_sizes(paths), quiet=split != "train")
    poses = torch.stack([read_pose(frame, label) for frame, label in frames])
    return PosedImages(
        folder=file.parent,
        paths=paths,
        names=tuple(str(PurePosixPath(name)) for name in written),
        poses=poses,
        intrinsics=lenses.intrinsics,
        sizes=lenses.sizes,
        model=lenses.model,
        lens=lenses.lens,
        masks=companions(file.parent, frames, "mask_path", IMAGE_SUFFIXES, split),
        depths=companions(file.parent, frames, "depth_file_path", DEPTH_SUFFIXES, split),
        times=read_times(frames),
        points=_points(file, content, split),
        tracks=_tracks(file, content, frames, poses),
        taken=_taken(content, frames),
    )


def _taken(content: dict[str, Any], frames: Frames) -> tuple[Taken, ...] | None:
    """Return the exposures that frames state, or the file for all of them; None if no frame has all of `EXPOSURE`."""
    stated = [{key: frame.get(key, content.get(key)) for key in EXPOSURE} for frame, _ in frames]
    if not any(None not in values.values() for values in stated):
        return None
    taken = []
    for values, (_, label) in zip(stated, frames, strict=True):
        if None in values.values():
            taken.append(Taken())
            continue
        seconds, f_number, iso = (number(values[key], key, label, True) for key in EXPOSURE)
        taken.append(Taken.of(seconds, f_number, iso))
    return tuple(taken)


def _may_be_metres(depths: tuple[Path | None, ...] | None) -> bool:
    """Return whether a file of `depths` may hold fractions, so that its unit is not known to be small."""
    return any(path is not None and path.suffix.lower() in (".exr", ".npy") for path in depths or ())


def _points(file: Path, content: dict[str, Any], split: Split) -> Tensor | None:
    """Return the sparse points, in the frame of the poses."""
    if content.get("ply_file_path") is None:
        return None
    written = file_name(content["ply_file_path"], "ply_file_path", str(file))
    (path,) = on_disk(file.parent, [written], "points", (".ply",), quiet=split != "train")
    if not path.is_file():
        say(f"{path} does not exist: {nearest_on_disk(path)}; continuing without its points")
        return None
    return read_points(path)


def _tracks(file: Path, content: dict[str, Any], frames: Frames, poses: Tensor) -> Tracks | None:
    """Return which images see which points, from the COLMAP model beside the file, in the frame of the poses."""
    names = [
        names_in_model(file_name(frame["file_path"], "file_path", label), frame.get("source_path"))
        for frame, label in frames
    ]
    return tracks_beside(file.parent, names, poses, *_applied(content, file))


def _lists(file: Path, content: dict[str, Any], names: tuple[str, ...]) -> dict[str, set[str]]:
    """Return split -> image names, for the splits that the file lists."""
    lists, known = {}, {spelled(name): name for name in names}
    for split in ("train", "val", "test"):
        key = f"{split}_filenames"
        listed = content.get(key)
        if listed is None:
            continue
        if not isinstance(listed, list):
            raise DataError(f"{file}: '{key}' is {shown(listed)}; it must be a list of names")
        lists[split] = {known.get(spelled(name), name) for name in (file_name(name, key, str(file)) for name in listed)}
        unknown = sorted(lists[split] - set(names))
        if unknown:
            raise DataError(f"{file}: '{key}' lists {shown(unknown[0])}, which is not the file_path of any frame")
    return lists


def _sorted(names: list[str]) -> Tensor:
    return torch.tensor(sorted(range(len(names)), key=lambda index: names[index]), dtype=torch.int64)


def _listed(names: list[str], split: Split, lists: dict[str, set[str]]) -> Tensor:
    """Select by the file's own lists. val and test substitute for each other; train is everything not held out."""
    alternative: Split = "test" if split == "val" else "val"
    if split == "train" and split not in lists:
        held = lists.get("val", set()) | lists.get("test", set())
        selected = set(names) - held
    else:
        selected = lists.get(split, lists.get(alternative, set()))
    order = _sorted(names)
    return order[torch.tensor([names[index] in selected for index in order.tolist()])]


def _fraction(names: list[str], split: Split, fraction: float) -> Tensor:
    """Select evenly spaced images to train on, first and last included; the others are held out."""
    count = len(names)
    training = torch.zeros(count, dtype=torch.bool)
    training[evenly_spaced(count, math.ceil(count * fraction))] = True
    return _sorted(names)[training if split == "train" else ~training]


def _by_name(names: list[str], split: Split) -> Tensor:
    order = _sorted(names)
    held = [any(word in PurePosixPath(names[index]).name for word in ("eval", "val", "test")) for index in order]
    return order[torch.tensor(held) == (split != "train")]


def _with_cube(scene: ParsedScene, content: dict[str, Any], file: Path, scene_scale: float) -> ParsedScene:
    """Return the scene with instant-ngp's cube as box, if `aabb_scale` is given.

    The placement moves and scales the cube but does not rotate it: its edges are parallel to the axes of the scene.
    """
    cube = ngp_cube(content, file)
    if cube is None or scene.transform is None:
        return scene
    center, edge = cube
    center = scene.placement.points(center[None])[0]
    half = 0.5 * edge * scene.scale * scene_scale
    box = torch.stack([center - half, center + half]).float()
    return replace(scene, box=checked_box(box, f"{file}: 'aabb_scale', 'scale' and 'offset'"))


def _from_original(scene: ParsedScene, content: dict[str, Any], file: Path) -> ParsedScene:
    """Return the scene with a transform from the original frame, before the file's transform, so that exports use it.

    The file's frame is `applied_scale * (applied_transform @ x)` of the original.
    """
    scene = from_original(scene, *_applied(content, file))
    if scene.transform is None or not bool(scene.transform.isfinite().all()) or not 0 < scene.scale < math.inf:
        raise DataError(
            f"{file}: 'applied_transform' and 'applied_scale' give a transform out of range; correct them, "
            "or remove both"
        )
    return scene


def _applied(content: dict[str, Any], file: Path) -> tuple[Tensor, float]:
    """Return rotation and translation (4, 4) float64, and the scale after them, of the file's transform."""
    matrix, scale, name = content.get("applied_transform"), content.get("applied_scale"), f"{file}: 'applied_transform'"
    applied = torch.eye(4, dtype=torch.float64) if matrix is None else rigid(matrix, name, name)
    return applied, 1.0 if scale is None else number(scale, "applied_scale", str(file), positive=True)

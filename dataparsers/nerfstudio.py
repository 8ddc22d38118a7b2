"""Captures as nerfstudio and instant-ngp write them: one transforms.json with poses and intrinsics."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import torch
from torch import Tensor

from dataparsers.captured import (
    ENDINGS,
    Captured,
    Division,
    Photographs,
    captured_scene,
    checked_box,
    from_original,
    image_sizes,
)
from dataparsers.reading import file_name, number, numbers, read_json, read_pose, read_times, rigid, shown, side
from framework import DataError, ParsedScene
from framework.base.console import say
from framework.base.errors import nearest
from framework.data.dataset import Split
from framework.data.ply import read_points

TRANSFORMS = "transforms.json"
EvalMode = Literal["interval", "fraction", "filename", "all"]
PERSPECTIVE = ("opencv", ("k1", "k2", "p1", "p2", "k3", "", "", "", "k4"))
FISHEYE = ("fisheye", ("k1", "k2", "k3", "k4"))
CAMERA_MODELS: dict[str, tuple[str, tuple[str, ...]]] = {
    **dict.fromkeys(("PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"), PERSPECTIVE),
    **dict.fromkeys(("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), FISHEYE),
    "FULL_OPENCV": ("opencv", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "")),
    "EQUIRECTANGULAR": ("equirectangular", ()),
    "ORTHOGRAPHIC": ("orthographic", ()),
    "ORTHOPHOTO": ("orthographic", ()),
}
"""`camera_model` -> our projection, and under which name the file has each coefficient of `LENSES`; '' for none."""
NGP_SCALE, NGP_OFFSET = 0.33, [0.5, 0.5, 0.5]
"""instant-ngp's unit cube: it puts a position x of the file at `scale * x + offset` unless the file has its own."""


@dataclass(frozen=True)
class Nerfstudio(Captured):
    """Flags of the nerfstudio format."""

    eval_mode: EvalMode = "interval"
    """How photographs are held out: every so many-th (--eval-interval); a fraction (--train-split-fraction); those
    with eval, val or test in their name (filename); or none, all being in every split. A file's own train_filenames,
    val_filenames and test_filenames go before all of these but the last."""
    train_split_fraction: float = 0.9
    """Which part of the photographs to train on, spread evenly, with --eval-mode fraction."""
    depth_unit_scale_factor: float = 0.001
    """Units of the input that a step of a depth image stands for: metres, of one in millimetres."""

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
        content = read_json(file)
        photographs = _photographs(file, content)
        lists = {} if self.eval_mode == "all" else _lists(file, content, photographs.names)
        scene = captured_scene(self, photographs, split, self._division(split, lists))
        scene = replace(scene, depth_unit=self.depth_unit_scale_factor)
        return _from_original(_with_cube(scene, content, file, self.scene_scale), content, file)

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


def _photographs(file: Path, content: dict[str, Any]) -> Photographs:
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise DataError(f"{file} lists no frames")
    where = [f"{file}: frame {index}" for index in range(len(frames))]
    for frame, place in zip(frames, where, strict=True):
        if not isinstance(frame, dict):
            raise DataError(f"{place} is {shown(frame)}; it must be an object with 'file_path'")
    placed = list(zip(frames, where, strict=True))
    written = [file_name(frame.get("file_path"), "file_path", place) for frame, place in placed]
    paths = [_image(file.parent / name) for name in written]
    sizes = _sizes(frames, content, where, paths)
    model, keys = _camera_model(file, content, frames)
    cameras = [
        _intrinsics(frame, content, size, model, place)
        for frame, size, place in zip(frames, sizes.tolist(), where, strict=True)
    ]
    lens = [[_number(frame, content, key, place) or 0.0 for key in keys] for frame, place in placed]
    return Photographs(
        folder=file.parent,
        paths=tuple(paths),
        names=tuple(str(PurePosixPath(name)) for name in written),
        poses=torch.stack([read_pose(frame, place, torch.float64) for frame, place in placed]),
        intrinsics=torch.tensor(cameras, dtype=torch.float64),
        sizes=sizes,
        model=model,
        lens=torch.tensor(lens) if keys else None,
        masks=_companions(file.parent, frames, "mask_path", where),
        depths=_companions(file.parent, frames, "depth_file_path", where),
        times=read_times(frames, where),
        points=_points(file, content),
    )


def _value(frame: dict[str, Any], content: dict[str, Any], key: str) -> Any:
    """A frame's own value, else the file's for all; None where neither has one."""
    own = frame.get(key)
    return content.get(key) if own is None else own


def _number(frame: dict[str, Any], content: dict[str, Any], key: str, where: str) -> float | None:
    value = _value(frame, content, key)
    return None if value is None else number(value, key, where)


def _side(frame: dict[str, Any], content: dict[str, Any], key: str, where: str) -> int | None:
    value = _value(frame, content, key)
    return None if value is None else side(value, key, where)


def _image(path: Path) -> Path:
    """The file meant by a path that may lack its ending."""
    if path.suffix in ENDINGS or path.is_file():
        return path
    complete = [path.with_name(path.name + ending) for ending in ENDINGS]
    return next((other for other in complete if other.is_file()), complete[0])


def _companions(
    folder: Path, frames: list[dict[str, Any]], key: str, where: list[str]
) -> tuple[Path | None, ...] | None:
    """Files that go with the frames' images; None for frames without, and where no frame has one."""
    named = [frame.get(key) for frame in frames]
    if all(name is None for name in named):
        return None
    return tuple(
        None if name is None else folder / file_name(name, key, place) for name, place in zip(named, where, strict=True)
    )


def _sizes(frames: list[dict[str, Any]], content: dict[str, Any], where: list[str], paths: list[Path]) -> Tensor:
    """(M, 2) int64 width and height that intrinsics are for: as the file says, else those of the images."""
    stated = [[_side(frame, content, key, place) for key in "wh"] for frame, place in zip(frames, where, strict=True)]
    if any(None in size for size in stated):
        found = image_sizes(paths).tolist()
        stated = [other if None in size else size for size, other in zip(stated, found, strict=True)]
    return torch.tensor(stated)


def _camera_model(file: Path, content: dict[str, Any], frames: list[dict[str, Any]]) -> tuple[str, tuple[str, ...]]:
    """The projection of all frames, and the names of its coefficients in the file."""
    if content.get("is_fisheye") is True:  # instant-ngp's word for it
        return FISHEYE
    given = [_value(frame, content, "camera_model") or "PERSPECTIVE" for frame in frames]
    named = {name if isinstance(name, str) else shown(name) for name in given}
    for name in sorted(named - set(CAMERA_MODELS)):
        raise DataError(f"{file}: unknown camera_model '{shown(name)[1:-1]}'. {nearest(name, CAMERA_MODELS)}")
    found = {CAMERA_MODELS[name] for name in named}
    if len(found) > 1:
        raise DataError(f"{file} mixes the camera models {' and '.join(sorted(named))}; make a file of each")
    return found.pop()


def _intrinsics(
    frame: dict[str, Any], content: dict[str, Any], size: list[int], model: str, where: str
) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy in pixels of an image of `size`; the principal point is its centre where it is not given."""
    fx, fy = (_focal(frame, content, axis, length, where) for axis, length in zip("xy", size, strict=True))
    if model == "equirectangular":  # the file's focal length is half the width of a whole panorama, ours one radian
        fx, fy = (fx or fy or size[0] / 2) / math.pi, (fy or fx or size[1]) / math.pi
    elif fx is None and fy is None:
        raise DataError(f"{where}: there is neither 'fl_x' nor 'camera_angle_x', and so no focal length")
    cx, cy = (_number(frame, content, key, where) for key in ("cx", "cy"))
    return (
        fx or fy or 0.0,
        fy or fx or 0.0,
        size[0] / 2 if cx is None else cx,
        size[1] / 2 if cy is None else cy,
    )


def _focal(frame: dict[str, Any], content: dict[str, Any], axis: str, length: int, where: str) -> float | None:
    """Focal length in pixels along an image's axis of `length`; None where the file does not say."""
    for source in (frame, content):  # a frame's own angle goes before the focal length of all
        if source.get(f"fl_{axis}") is not None:
            return number(source[f"fl_{axis}"], f"fl_{axis}", where, positive=True)
        name = f"camera_angle_{axis}"
        if source.get(name) is not None:
            angle = number(source[name], name, where, positive=True)
            if not 1e-6 < angle < math.pi:
                raise DataError(f"{where}: '{name}' is {angle}; it must be an angle between 0 and pi radians")
            return 0.5 * length / math.tan(0.5 * angle)
    return None


def _points(file: Path, content: dict[str, Any]) -> Tensor | None:
    """Sparse points, which are in the frame of the poses."""
    if content.get("ply_file_path") is None:
        return None
    path = file.parent / file_name(content["ply_file_path"], "ply_file_path", str(file))
    if not path.is_file():
        say(f"{path} is missing: going on without its sparse points")
        return None
    return read_points(path)


def _lists(file: Path, content: dict[str, Any], names: tuple[str, ...]) -> dict[str, set[str]]:
    """Split -> names of its photographs, of the splits for which the file has a list."""
    lists = {}
    for split in ("train", "val", "test"):
        key = f"{split}_filenames"
        listed = content.get(key)
        if listed is None:
            continue
        if not isinstance(listed, list):
            raise DataError(f"{file}: '{key}' is {shown(listed)}; it must be a list of names")
        lists[split] = {str(PurePosixPath(file_name(name, key, str(file)))) for name in listed}
        unknown = sorted(lists[split] - set(names))
        if unknown:
            raise DataError(f"{file}: '{key}' lists {shown(unknown[0])}, which is no frame's file_path")
    return lists


def _sorted(names: list[str]) -> Tensor:
    return torch.tensor(sorted(range(len(names)), key=lambda index: names[index]), dtype=torch.int64)


def _listed(names: list[str], split: Split, lists: dict[str, set[str]]) -> Tensor:
    """By the file's own lists. val and test stand in for each other; train is all that is not held out."""
    other: Split = "test" if split == "val" else "val"
    if split == "train" and split not in lists:
        held = lists.get("val", set()) | lists.get("test", set())
        wanted = set(names) - held
    else:
        wanted = lists.get(split, lists.get(other, set()))
    order = _sorted(names)
    return order[torch.tensor([names[index] in wanted for index in order.tolist()])]


def _fraction(names: list[str], split: Split, fraction: float) -> Tensor:
    """The first, the last and evenly many between them to train on; the others held out."""
    count = len(names)
    training = torch.zeros(count, dtype=torch.bool)
    training[torch.linspace(0, count - 1, math.ceil(count * fraction), dtype=torch.float64).long()] = True
    return _sorted(names)[training if split == "train" else ~training]


def _by_name(names: list[str], split: Split) -> Tensor:
    order = _sorted(names)
    held = [any(word in PurePosixPath(names[index]).name for word in ("eval", "val", "test")) for index in order]
    return order[torch.tensor(held) == (split != "train")]


def _with_cube(scene: ParsedScene, content: dict[str, Any], file: Path, scene_scale: float) -> ParsedScene:
    """Where instant-ngp's `aabb_scale` is given, its cube instead of the one around the scene's origin.

    The cube keeps its centre and its size through placing, `aabb_scale / scale` units of the file along an edge,
    but not its turn: its edges are parallel to the axes of the scene.
    """
    if content.get("aabb_scale") is None or scene.transform is None:
        return scene
    unit = number(content.get("scale", NGP_SCALE), "scale", str(file), positive=True)
    edge = number(content["aabb_scale"], "aabb_scale", str(file), positive=True) / unit
    offset = numbers(content.get("offset", NGP_OFFSET), 3, "offset", str(file))
    center = (0.5 - torch.tensor(offset)) / unit
    center = scene.scale * (scene.transform[:, :3] @ center + scene.transform[:, 3])
    half = 0.5 * edge * scene.scale * scene_scale
    box = torch.stack([center - half, center + half])
    return replace(scene, box=checked_box(box, f"{file}: 'aabb_scale', 'scale' and 'offset'"))


def _from_original(scene: ParsedScene, content: dict[str, Any], file: Path) -> ParsedScene:
    """With a transform from what the file was made from, rather than from the file, so that exports come out there.

    The file's frame is `applied_scale * (applied_transform @ x)` of that.
    """
    matrix, scale, name = content.get("applied_transform"), content.get("applied_scale"), f"{file}: 'applied_transform'"
    applied = torch.eye(4, dtype=torch.float64) if matrix is None else rigid(matrix, name, name)
    scale = 1.0 if scale is None else number(scale, "applied_scale", str(file), positive=True)
    scene = from_original(scene, applied, scale)
    if scene.transform is None or not bool(scene.transform.isfinite().all()) or not 0 < scene.scale < math.inf:
        raise DataError(f"{file}: 'applied_transform' and 'applied_scale' lead too far away")
    return scene

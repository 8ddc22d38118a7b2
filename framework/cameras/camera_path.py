"""Camera paths in files: the camera_path.json that nerfstudio's viewer writes, read and written.

Poses are camera-to-world matrices with OpenGL axes, in the frame of the trained scene after the data format has placed
the input, as in nerfstudio. Captures are placed by nerfstudio's rules and NeRF-Synthetic data is not moved, so a path
made in nerfstudio shows the same views here. Files written here also hold the placement of their scene (`placement`,
which nerfstudio ignores). So they fit a run of the same data with another placement.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from nerfloom.base.atomic import write_atomically
from nerfloom.base.errors import DataError, nearest, shown
from nerfloom.base.json_files import number, read_json
from nerfloom.cameras.cameras import Cameras, check_pose
from nerfloom.cameras.framing import perspective, size_of
from nerfloom.cameras.poses import Placement
from nerfloom.geometry.lenses import panorama

CameraType = Literal["perspective", "fisheye", "equirectangular"]
CAMERA_TYPES: dict[str, str] = {"perspective": "pinhole", "fisheye": "fisheye", "equirectangular": "equirectangular"}
"""`camera_type` of the file -> projection, a key of `LENSES`."""
MAX_SIDE, MAX_IMAGE = 16_384, 2**27
"""Maximum width and height, and maximum number of pixels of an image."""
MAX_FRAMES = 100_000
"""Maximum number of frames of a path."""
MAX_COORDINATE = 1e9
"""Maximum coordinate of a camera, scene units."""
FIELDS_OF_VIEW = (0.01, 179.0)
"""Range of the vertical field of view, degrees."""
SPEED_RANGE = (0.01, 1000.0)
"""Range of the number of frames per second."""
PANORAMA_FOV = 90.0
"""Field of view written for a panorama, degrees; panoramas do not use it."""


@dataclass(frozen=True)
class Keyframe:
    """A camera placed by a user; an editor interpolates between keyframes."""

    pose: Tensor
    """(3, 4) camera-to-scene, float64."""
    fov: float
    """Vertical field of view, degrees."""
    time: float | None = None
    """Time in [0, 1]; None for a static scene."""
    transition: float | None = None
    """Seconds from the previous keyframe; None for the path's default."""


@dataclass(frozen=True)
class CameraPath:
    """F cameras of one type and size, one for each frame of a video."""

    camera_type: CameraType
    """Projection: perspective; fisheye, with angles from the axis in proportion to radii; or equirectangular, all
    directions."""
    width: int
    """Width of the images, pixels."""
    height: int
    """Height of the images, pixels."""
    poses: Tensor
    """(F, 3, 4) camera-to-scene, float64, OpenGL axes."""
    fovs: Tensor
    """(F,) vertical field of view, degrees, float64; not used if equirectangular. A fisheye's focal length in pixels
    per radian equals a perspective camera's in pixels per tangent."""
    seconds: float
    """Duration."""
    times: Tensor | None = None
    """(F,) time of each frame in [0, 1]; None if the path has none."""
    is_cycle: bool = False
    """Whether the last keyframe is joined to the first."""
    smoothness_value: float = 0.0
    """Tension of the spline through the keyframes."""
    keyframes: tuple[Keyframe, ...] = ()
    """Cameras that the path was made from; empty if unknown."""
    placement: Placement | None = None
    """Placement of the input in the path's scene; None if unknown."""
    has_crop: bool = False
    """Whether the file asks for a crop box, which is not read."""

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def fps(self) -> float:
        """Frames per second."""
        return len(self) / self.seconds

    def cameras(self) -> Cameras:
        """Return the F cameras."""
        found = replace(
            perspective(self.poses, self.width, self.height, self.fovs), model=CAMERA_TYPES[self.camera_type]
        )
        if self.camera_type != "equirectangular":
            return found
        fx, fy, cx, cy = (torch.full((len(self),), value) for value in panorama(self.width, self.height))
        return replace(found, fx=fx, fy=fy, cx=cx, cy=cy)

    def framed(self, width: int | None = None, height: int | None = None, fov: float | None = None) -> CameraPath:
        """Return the path with images of another size, or with one field of view.

        Args:
            width: width of the images, pixels; None to keep it, or the aspect ratio if `height` is given.
            height: height of the images, pixels; None likewise.
            fov: vertical field of view of all frames, degrees; None to keep the path's.
        """
        new_width, new_height = size_of((self.width, self.height), width, height)
        fovs = self.fovs if fov is None else torch.full_like(self.fovs, fov)
        return replace(self, width=new_width, height=new_height, fovs=fovs)

    def placed(self, placement: Placement) -> CameraPath:
        """Return the path in a scene with another `placement` of the same input; unchanged if its own is unknown."""
        if self.placement is None:
            return self
        before = self.placement

        def moved(poses: Tensor) -> Tensor:
            return placement.poses(before.original_poses(poses))

        keyframes = tuple(replace(one, pose=moved(one.pose[None])[0]) for one in self.keyframes)
        return replace(self, poses=moved(self.poses), keyframes=keyframes, placement=placement)


def write_camera_path(file: Path, path: CameraPath) -> None:
    """Write a camera `path` as a JSON `file` with all that nerfstudio's viewer and ns-render read.

    Raises:
        OSError: if the file cannot be written; the old file is then unchanged.
    """
    aspect = path.width / path.height
    frames = [
        {"camera_to_world": _flat(pose), "fov": fov, "aspect": aspect}
        for pose, fov in zip(path.poses, path.fovs.tolist(), strict=True)
    ]
    if path.times is not None:
        for frame, time in zip(frames, path.times.tolist(), strict=True):
            frame["render_time"] = time
    content: dict[str, Any] = {
        "default_fov": frames[0]["fov"],
        "default_transition_sec": path.seconds / max(len(path.keyframes) - (not path.is_cycle), 1),
        "keyframes": [_keyframe(one, aspect) for one in path.keyframes],
        "camera_type": path.camera_type,
        "render_height": path.height,
        "render_width": path.width,
        "fps": path.fps,
        "seconds": path.seconds,
        "is_cycle": path.is_cycle,
        "smoothness_value": path.smoothness_value,
        "camera_path": frames,
    }
    if path.placement is not None:
        content["placement"] = {"transform": path.placement.transform.tolist(), "scale": path.placement.scale}
    text = json.dumps(content, allow_nan=False) + "\n"
    write_atomically(file, lambda stream: stream.write(text.encode()))


def _keyframe(keyframe: Keyframe, aspect: float) -> dict[str, Any]:
    content = {
        "matrix": _flat(keyframe.pose),
        "fov": keyframe.fov,
        "aspect": aspect,
        "override_transition_enabled": keyframe.transition is not None,
        "override_transition_sec": keyframe.transition,
    }
    if keyframe.time is not None:
        content |= {"render_time": keyframe.time, "override_time_enabled": True}
    return content


def _flat(pose: Tensor) -> list[float]:
    """Return the 16 numbers of a pose (3, 4), row by row."""
    return [*pose.double().flatten().tolist(), 0.0, 0.0, 0.0, 1.0]


# -- reading ------------------------------------------------------------------------------------------------------


def read_camera_path(file: Path) -> CameraPath:
    """Read a camera path from a JSON `file` in the format of nerfstudio's viewer.

    Raises:
        DataError: if the file cannot be read, has another format, or holds invalid cameras.
    """
    content = _object(read_json(file), str(file))
    width, height = (_side(content, f"render_{name}", file) for name in ("width", "height"))
    if width * height > MAX_IMAGE:
        raise DataError(f"{file}: images of {width}x{height} pixels are too large; the limit is {MAX_IMAGE} pixels")
    camera_type = content.get("camera_type", "perspective")
    if camera_type not in get_args(CameraType):
        hint = nearest(camera_type, CAMERA_TYPES) if isinstance(camera_type, str) else nearest("", CAMERA_TYPES)
        raise DataError(f"{file}: unknown camera_type {shown(camera_type)}. {hint}")
    frames = _list(content, "camera_path", file)
    if not 1 <= len(frames) <= MAX_FRAMES:
        raise DataError(f"{file}: 'camera_path' has {len(frames)} frames; it must have 1 to {MAX_FRAMES}")
    labels = [f"{file}: frame {index} of 'camera_path'" for index in range(len(frames))]
    placed = [(_object(frame, label), label) for frame, label in zip(frames, labels, strict=True)]
    for frame, label in placed:
        if frame.get("aspect") is not None:
            _number(frame, "aspect", label, positive=True)
    return CameraPath(
        camera_type=camera_type,
        width=width,
        height=height,
        poses=torch.stack([_pose(frame, "camera_to_world", label) for frame, label in placed]),
        fovs=torch.tensor([_fov(frame, camera_type, label) for frame, label in placed], dtype=torch.float64),
        seconds=_seconds(content, len(frames), str(file)),
        times=_times(placed),
        is_cycle=_flag(content, "is_cycle", str(file)),
        smoothness_value=_number(content, "smoothness_value", str(file), default=0.0),
        keyframes=_keyframes(content, camera_type, file),
        placement=read_placement(content["placement"], f"{file}: 'placement'") if "placement" in content else None,
        has_crop=content.get("crop") is not None,
    )


def read_transforms(file: Path) -> Placement:
    """Read the placement of a run, ours or nerfstudio's, from its dataparser_transforms.json, `file`.

    Raises:
        DataError: if the file cannot be read or holds no similarity.
    """
    return read_placement(read_json(file), str(file))


def read_placement(content: Any, where: str) -> Placement:
    """Return the placement of an object `content`, `where` in messages, by `transform` (3 x 4) and `scale`.

    Raises:
        DataError: if the content is not a similarity.
    """
    values = _object(content, where)
    transform = _rigid(values.get("transform"), f"{where}: 'transform'")
    scale = _number(values, "scale", where, positive=True)
    if not 1 / MAX_COORDINATE < scale < MAX_COORDINATE:
        raise DataError(f"{where}: 'scale' is {scale:g}, which is out of range")
    return Placement(transform, scale)


def _object(value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise DataError(f"{where} is {shown(value)}; it must be an object: names and values in braces")
    return value


def _list(content: dict[str, Any], name: str, file: Path) -> list[Any]:
    value = content.get(name)
    if not isinstance(value, list):
        raise DataError(f"{file}: '{name}' is {shown(value)}; it must be a list of cameras")
    return value


def _number(
    content: dict[str, Any], name: str, where: str, positive: bool = False, default: float | None = None
) -> float:
    """Return a `number` of an object; `default` if it is missing and has a default."""
    value = content.get(name)
    return default if value is None and default is not None else number(value, name, where, positive)


def _flag(content: dict[str, Any], name: str, where: str) -> bool:
    value = content.get(name, False)
    if not isinstance(value, bool):
        raise DataError(f"{where}: '{name}' is {shown(value)}; it must be true or false")
    return value


def _side(content: dict[str, Any], name: str, file: Path) -> int:
    side = _number(content, name, str(file), positive=True)
    if side != round(side) or not 1 <= side <= MAX_SIDE:
        raise DataError(f"{file}: '{name}' is {shown(content[name])}; it must be from 1 to {MAX_SIDE} pixels")
    return round(side)


def _seconds(content: dict[str, Any], frames: int, where: str) -> float:
    """Return the duration, from `seconds`, or from `fps` if that is missing."""
    if content.get("seconds") is not None:
        seconds = _number(content, "seconds", where, positive=True)
    else:
        seconds = frames / _number(content, "fps", where, positive=True)
    slowest, fastest = SPEED_RANGE
    if not seconds * slowest <= frames <= seconds * fastest:
        raise DataError(
            f"{where}: {frames} frames in {seconds:g} seconds; allowed are {slowest:g} to {fastest:g} per second"
        )
    return seconds


def _fov(content: dict[str, Any], camera_type: str, where: str) -> float:
    if camera_type == "equirectangular":
        return _number(content, "fov", where, default=PANORAMA_FOV)
    fov = _number(content, "fov", where)
    least, most = FIELDS_OF_VIEW
    if not least <= fov <= most:
        raise DataError(f"{where}: 'fov' is {fov:g}; it must be from {least:g} to {most:g} degrees")
    return fov


def _times(placed: list[tuple[dict[str, Any], str]]) -> Tensor | None:
    """Return the times of all frames, or None if no frame has one. Splines can slightly overshoot [0, 1]."""
    if not any("render_time" in frame for frame, _ in placed):
        return None
    times = [_number(frame, "render_time", label) for frame, label in placed]
    return torch.tensor(times, dtype=torch.float64).clamp(0, 1).float()


def _pose(content: dict[str, Any], name: str, where: str) -> Tensor:
    """Return a pose (3, 4) from 16 numbers or four rows of four."""
    return _rigid(content.get(name), f"{where}: '{name}'")


def _rigid(value: Any, where: str) -> Tensor:
    """Return the first three rows of a rigid matrix, given as 12 or 16 numbers, or as rows of four."""
    rows = value if isinstance(value, list) and len(value) <= 16 else []
    flat = [part for row in rows for part in (row if isinstance(row, list) and len(row) == 4 else [row])]
    if len(flat) not in (12, 16) or not all(type(part) in (int, float) for part in flat):
        raise DataError(f"{where} is {shown(value)}; it must be a 4x4 matrix, 16 numbers row by row")
    try:
        pose = torch.tensor(flat, dtype=torch.float64).view(-1, 4)
    except (OverflowError, RuntimeError) as error:  # an integer beyond any float
        raise DataError(f"{where} holds a number out of range") from error
    check_pose(pose, where)
    if not bool((pose[:3, 3].abs() < MAX_COORDINATE).all()):
        raise DataError(f"{where}: the position is farther than {MAX_COORDINATE:g} from the origin")
    return pose[:3]


def _keyframes(content: dict[str, Any], camera_type: str, file: Path) -> tuple[Keyframe, ...]:
    """Return the keyframes; none for files of nerfstudio's first viewer, which store matrices as text."""
    given = content.get("keyframes")
    given = [] if given is None else _list(content, "keyframes", file)
    if len(given) > MAX_FRAMES:
        raise DataError(f"{file}: 'keyframes' has {len(given)} cameras; the limit is {MAX_FRAMES}")
    found = []
    for index, value in enumerate(given):
        where = f"{file}: {index} of 'keyframes'"
        keyframe = _object(value, where)
        if isinstance(keyframe.get("matrix"), str):
            return ()
        time = None if keyframe.get("render_time") is None else _number(keyframe, "render_time", where)
        seconds = keyframe.get("override_transition_sec") if keyframe.get("override_transition_enabled") else None
        found.append(
            Keyframe(
                pose=_pose(keyframe, "matrix", where),
                fov=_fov(keyframe, camera_type, where),
                time=None if time is None else min(max(time, 0.0), 1.0),
                transition=None
                if seconds is None
                else number(seconds, "override_transition_sec", where, positive=True),
            )
        )
    return tuple(found)

"""Conversion of nerfbaselines' data sets, which are in memory, and their placement in a scene.

nerfbaselines' cameras have OpenCV's axes (x right, y down, z forward), the framework's have OpenGL's. Pixel centres are
at 0.5 in both.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.errors import DataError
from nerfloom.cameras.cameras import Cameras, check_pose, join_cameras
from nerfloom.cameras.colmap import PARAMETERS, from_colmap
from nerfloom.cameras.poses import NEAR, Placement, estimate_near, nearest_point, place
from nerfloom.data.dataset import Dataset, Masks, assemble
from nerfloom.data.decoding import Decoded, from_arrays
from nerfloom.data.masks import THRESHOLD
from nerfloom.data.parsed_scene import ParsedScene

DatasetDict = dict[str, Any]
"""nerfbaselines' `Dataset`. Its `cameras`, `image_paths`, `images`, `masks`, `points3D_xyz` and `metadata` are used."""
CAMERA_MODELS = ("pinhole", "opencv", "opencv_fisheye", "full_opencv")
"""nerfbaselines' camera models, in the order of its enumeration. COLMAP has all of them, with the same names."""
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Order of nerfbaselines' distortion parameters for all models; missing ones are zero."""
TO_OPENGL = np.array([1.0, -1.0, -1.0, 1.0])
"""Signs of a pose's columns that convert OpenCV's axes to OpenGL's."""
FAR = 1000.0
"""Distance where an unbounded scene ends, scene units."""
BOUND_SHARE = 0.9
"""Near distance as a fraction of the smallest depth stated by the data set. This depth is a percentile; a few are
smaller."""


@dataclass(frozen=True)
class FrameFlags:
    """Settings of the scene's region; nerfbaselines' overrides name them with the prefix `frame.`."""

    half_size: float | None = None
    """Half the side of the box of an object cut out by alpha, in the data set's units. Default: half the range between
    the smallest and the largest depth stated by the data set."""


@dataclass(frozen=True)
class ArrayImages:
    """M images in the data set's own frame and units."""

    paths: tuple[Path, ...]
    """M file names; the files need not exist."""
    cameras: Cameras
    """M cameras with float64 poses."""
    decoded: Decoded
    """The images' pixels."""
    bounds: tuple[float, float] | None
    """Smallest and largest depth of the scene, if stated by the data set."""
    points: Tensor | None
    """(K, 3) float64 sparse points, or None."""

    @classmethod
    def of(cls, dataset: DatasetDict) -> ArrayImages:
        """Convert nerfbaselines' dictionary `dataset`. Images and masks may be padded beyond their camera's size.

        Raises:
            DataError: for linear colours, invalid arrays, or invalid cameras.
        """
        space = dataset["metadata"].get("color_space") or "srgb"
        if space != "srgb":
            raise DataError(f"the images' colours are {space}; only sRGB is supported")
        cameras, paths = dataset["cameras"], tuple(map(Path, dataset["image_paths"]))
        sizes = [(int(width), int(height)) for width, height in cameras.image_sizes]
        masks = dataset.get("masks", dataset.get("sampling_masks"))  # the name in early versions
        images = [
            _unpadded(image, *size, path) for image, size, path in zip(dataset["images"], sizes, paths, strict=True)
        ]
        keep = None
        if masks is not None:
            keep = [
                _as_bool(_unpadded(mask, *size, path)) for mask, size, path in zip(masks, sizes, paths, strict=True)
            ]
        bounds, points = cameras.nears_fars, dataset.get("points3D_xyz")
        return cls(
            paths=paths,
            cameras=cameras_of(cameras, (path.name for path in paths)),
            decoded=from_arrays(images, keep),
            bounds=None if bounds is None else (float(bounds[:, 0].min()), float(bounds[:, 1].max())),
            points=None if points is None else torch.from_numpy(np.array(points, np.float64)),
        )


def cameras_of(cameras: Any, names: Iterable[str]) -> Cameras:
    """Convert nerfbaselines' cameras, in the data set's own frame, with float64 poses.

    Args:
        cameras: M cameras, each with `poses` (3 or 4, 4) camera-to-world, `intrinsics` (4,) fx, fy, cx, cy in pixels,
            `camera_models`, `distortion_parameters` (up to 8,) and `image_sizes` (2,) width and height.
        names: M names for messages.

    Raises:
        DataError: for poses that are not rigid, invalid intrinsics, or models that cannot be combined.
    """
    return join_cameras([_camera(camera, name) for camera, name in zip(cameras, names, strict=True)])


def _camera(camera: Any, name: str) -> Cameras:
    model = CAMERA_MODELS[int(camera.camera_models)].upper()
    given = dict(zip(COEFFICIENTS, camera.distortion_parameters, strict=False))
    coefficients = [given.get(key, 0.0) for key in PARAMETERS[model][1].split()[4:]]  # after fx fy cx cy
    width, height = (int(side) for side in camera.image_sizes)
    numbers = from_colmap(model, [*camera.intrinsics, *coefficients], width, height)
    pose = torch.from_numpy(np.array(camera.poses, np.float64)[:3] * TO_OPENGL)
    check_pose(pose, name)
    return Cameras(
        camera_to_worlds=pose[None],
        fx=torch.tensor([numbers.fx]),
        fy=torch.tensor([numbers.fy]),
        cx=torch.tensor([numbers.cx]),
        cy=torch.tensor([numbers.cy]),
        widths=torch.tensor([width]),
        heights=torch.tensor([height]),
        model=numbers.model,
        lens=torch.tensor([numbers.lens]) if numbers.lens else None,
    )


def _unpadded(image: Any, width: int, height: int, path: Path) -> np.ndarray:
    """Return the top left part (height, width, ...) of an array, without its padding."""
    image = np.asarray(image)
    if image.shape[0] < height or image.shape[1] < width:
        raise DataError(f"{path} is {image.shape[1]}x{image.shape[0]} pixels, but its camera is for {width}x{height}")
    return image[:height, :width]


def _as_bool(mask: np.ndarray) -> np.ndarray:
    """Convert a mask (H, W) or (H, W, 1) of any type to (H, W) bool, True for pixels to train on."""
    mask = mask.reshape(mask.shape[:2])
    return mask if mask.dtype == np.bool_ else mask >= (THRESHOLD if mask.dtype == np.uint8 else 0.5)


@dataclass(frozen=True)
class Frame:
    """Placement of a data set in the scene, and its region of interest."""

    placement: Placement
    """Transform from the data set's frame to the scene's."""
    box: Tensor
    """(2, 3) corners of the region of interest, scene coordinates."""
    near: float
    """Distance from a camera where the scene starts, scene units."""
    far: float
    """Distance from a camera where the scene ends, scene units."""
    unbounded: bool
    """Whether there may be visible content outside `box`."""

    @classmethod
    def of(cls, images: ArrayImages, flags: FrameFlags) -> Frame:
        """Return a box for `images` of an object cut out by alpha, by `flags`, else `ns-train`'s unbounded frame.

        Raises:
            DataError: if the size of the box cannot be determined.
        """
        alpha = images.decoded.pixels.shape[1] == 4
        return _object_frame(images, flags.half_size) if alpha else _unbounded_frame(images)

    @classmethod
    def saved(cls, checkpoint: dict[str, Any]) -> Frame:
        """Return the frame of the model in `checkpoint`."""
        scene, placement = checkpoint["scene"], Placement.of(checkpoint["transform"], checkpoint["scale"])
        return cls(placement, scene["box"], scene["near"], scene["far"], scene["unbounded"])

    def placed(self, cameras: Cameras) -> Cameras:
        """Transform `cameras` from the data set's own frame to the scene's."""
        return replace(cameras, camera_to_worlds=self.placement.poses(cameras.camera_to_worlds).float())


def _object_frame(images: ArrayImages, half_size: float | None) -> Frame:
    """Return the data set's own frame, with a box around the point that all cameras look at."""
    poses = images.cameras.camera_to_worlds
    centre = nearest_point(poses[:, :, 3], -poses[:, :, 2])
    distances = (poses[:, :, 3] - centre).norm(dim=-1)
    near, far = images.bounds or (float(distances.min()) / 2, float(distances.max()) * 1.5)
    half = (far - near) / 2 if half_size is None else half_size
    if not half > 0:
        raise DataError("the size of the object cannot be determined; set frame.half_size, in the data set's units")
    box = torch.stack([centre - half, centre + half]).float()
    return Frame(Placement.of(None, 1.0), box, near, far, unbounded=False)


def _unbounded_frame(images: ArrayImages) -> Frame:
    """Return a frame with the cameras' mean at the origin, their positions in [-1, 1], and near before all content."""
    placement = place(images.cameras.camera_to_worlds)
    cube = torch.tensor([[-1.0], [1.0]]).repeat(1, 3)
    frame = Frame(placement, cube, NEAR, FAR, unbounded=True)
    if images.points is not None:
        points = placement.points(images.points).float()
        near = estimate_near(frame.placed(images.cameras), points)
    elif images.bounds is not None:
        near = BOUND_SHARE * images.bounds[0] * placement.scale
    else:
        near = NEAR
    return replace(frame, near=min(near, FAR / 2))


def dataset_of(images: ArrayImages, frame: Frame, masks: Masks) -> Dataset:
    """Construct a data set of `images` in the scene's `frame`; `masks` says how masked-out pixels count.

    Raises:
        DataError: if no pixel has a ray.
    """
    parsed = ParsedScene(
        image_paths=images.paths,
        cameras=frame.placed(images.cameras),
        box=frame.box,
        near=frame.near,
        far=frame.far,
        transform=frame.placement.transform,
        scale=frame.placement.scale,
        unbounded=frame.unbounded,
        poses="photographs" if frame.unbounded else "exact",
    )
    return assemble(parsed, images.decoded, "train", masks)


def background_of(dataset: DatasetDict) -> Tensor:
    """Return the background (3,) for evaluating `dataset`; black if it is not stated, as in nerfbaselines."""
    color = dataset["metadata"].get("background_color")
    return torch.zeros(3) if color is None else torch.tensor(np.asarray(color).tolist()) / 255

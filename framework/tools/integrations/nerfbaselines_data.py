"""Photographs as nerfbaselines hands them over, in memory, and where they lie in a scene of ours.

There, cameras have OpenCV's axes (x right, y down, z ahead); here OpenGL's. Pixels' centres lie at 0.5 in both.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from framework.base.errors import DataError
from framework.cameras.cameras import Cameras, check_pose, join_cameras
from framework.cameras.colmap import PARAMETERS, from_colmap
from framework.cameras.poses import NEAR, Placement, nearest_point, nearest_shown, place
from framework.data.dataset import Dataset, Masks, ParsedScene, assemble
from framework.data.decoding import Decoded, from_arrays
from framework.data.masks import THRESHOLD

Handed = dict[str, Any]
"""nerfbaselines' `Dataset`; read are `cameras`, `image_paths`, `images`, `masks`, `points3D_xyz` and `metadata`."""
CAMERA_MODELS = ("pinhole", "opencv", "opencv_fisheye", "full_opencv")
"""nerfbaselines' camera models, in the order of their numbers. COLMAP has them all, under the same names."""
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""The order of nerfbaselines' distortion parameters, whichever the model; those that are left out are zero."""
TO_OPENGL = np.array([1.0, -1.0, -1.0, 1.0])
"""Signs of a pose's columns."""
FAR = 1000.0
"""Where a scene without a box ends, scene units."""
BOUND_SHARE = 0.9
"""Rays start at this share of the least depth that the data set states: of the points it was taken from, a few were
nearer."""


@dataclass(frozen=True)
class FrameFlags:
    """Settings of where the scene is; among nerfbaselines' overrides, `frame.` stands before their names."""

    half_size: float | None = None
    """Half the edge of the box of an object that alpha cuts out, the data set's units. If not given: half of what lies
    between the nearest and the farthest depth that the data set states."""


@dataclass(frozen=True)
class Photographs:
    """M photographs in the data set's own frame and units."""

    paths: tuple[Path, ...]
    """M names of files, which need not exist."""
    cameras: Cameras
    """M cameras; their poses are float64."""
    decoded: Decoded
    """Their pixels."""
    bounds: tuple[float, float] | None
    """Nearest and farthest depth of the scene, where the data set states them."""
    points: Tensor | None
    """(K, 3) float64 sparse points on surfaces, where there are any."""

    @classmethod
    def of(cls, handed: Handed) -> Photographs:
        """Read nerfbaselines' dictionary. Images and masks may be padded; what counts is their camera's size.

        Raises: DataError for linear colours, arrays that are no images, and cameras that cannot be.
        """
        space = handed["metadata"].get("color_space") or "srgb"
        if space != "srgb":
            raise DataError(f"the photographs' colours are {space}; only those stored as sRGB can be learnt from")
        cameras, paths = handed["cameras"], tuple(map(Path, handed["image_paths"]))
        sizes = [(int(width), int(height)) for width, height in cameras.image_sizes]
        masks = handed.get("masks", handed.get("sampling_masks"))  # as they were called at first
        images = [_cut(image, *size, path) for image, size, path in zip(handed["images"], sizes, paths, strict=True)]
        used = None
        if masks is not None:
            used = [_used(_cut(mask, *size, path)) for mask, size, path in zip(masks, sizes, paths, strict=True)]
        bounds, points = cameras.nears_fars, handed.get("points3D_xyz")
        return cls(
            paths=paths,
            cameras=cameras_of(cameras, (path.name for path in paths)),
            decoded=from_arrays(images, used),
            bounds=None if bounds is None else (float(bounds[:, 0].min()), float(bounds[:, 1].max())),
            points=None if points is None else torch.from_numpy(np.array(points, np.float64)),
        )


def cameras_of(handed: Any, names: Iterable[str]) -> Cameras:
    """nerfbaselines' cameras as ours, in the data set's own frame; their poses stay float64.

    Args:
        handed: M of them, each with `poses` (3 or 4, 4) camera-to-world, `intrinsics` (4,) fx, fy, cx, cy in pixels,
            `camera_models`, `distortion_parameters` (up to 8,) and `image_sizes` (2,) width and height.
        names: what to call each in messages.
    Raises: DataError for poses that are not rigid, impossible numbers, or models that one scene cannot mix.
    """
    return join_cameras([_camera(camera, name) for camera, name in zip(handed, names, strict=True)])


def _camera(camera: Any, name: str) -> Cameras:
    model = CAMERA_MODELS[int(camera.camera_models)].upper()
    given = dict(zip(COEFFICIENTS, camera.distortion_parameters, strict=False))
    coefficients = [given.get(key, 0.0) for key in PARAMETERS[model][1].split()[4:]]  # behind fx fy cx cy
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


def _cut(image: Any, width: int, height: int, path: Path) -> np.ndarray:
    """What an array (H, W, ...) holds of an image, without what only makes it as large as others."""
    image = np.asarray(image)
    if image.shape[0] < height or image.shape[1] < width:
        raise DataError(f"{path} is {image.shape[1]}x{image.shape[0]} pixels, but its camera is for {width}x{height}")
    return image[:height, :width]


def _used(mask: np.ndarray) -> np.ndarray:
    """(H, W) bool of a mask (H, W) or (H, W, 1) that says so in any type: where to learn from."""
    mask = mask.reshape(mask.shape[:2])
    return mask if mask.dtype == np.bool_ else mask >= (THRESHOLD if mask.dtype == np.uint8 else 0.5)


@dataclass(frozen=True)
class Frame:
    """Where a data set lies in the scene, and what of space matters."""

    placement: Placement
    """From the data set's frame to the scene's."""
    box: Tensor
    """(2, 3) scene coordinates."""
    near: float
    """Distance from a camera at which the scene may start, scene units."""
    far: float
    """Distance from a camera at which the scene ends, scene units."""
    unbounded: bool
    """There may be something to see outside `box`."""

    @classmethod
    def of(cls, photographs: Photographs, flags: FrameFlags) -> Frame:
        """Of what alpha cuts out, a box; of all else, a capture without end, as `ns-train` places one.

        Raises: DataError where nothing tells how large the box is.
        """
        alpha = photographs.decoded.pixels.shape[1] == 4
        return _around_an_object(photographs, flags.half_size) if alpha else _without_end(photographs)

    @classmethod
    def saved(cls, checkpoint: dict[str, Any]) -> Frame:
        """The frame that a checkpoint's model has learnt in."""
        scene, placement = checkpoint["scene"], Placement(checkpoint["transform"], checkpoint["scale"])
        return cls(placement, scene["box"], scene["near"], scene["far"], scene["unbounded"])

    def placed(self, cameras: Cameras) -> Cameras:
        """Cameras of the data set's own frame, in the scene."""
        poses = _exact(self.placement).poses(cameras.camera_to_worlds.double())
        return replace(cameras, camera_to_worlds=poses.float())


def _around_an_object(photographs: Photographs, half_size: float | None) -> Frame:
    """The data set's own frame, and a box around where all cameras look."""
    poses = photographs.cameras.camera_to_worlds
    centre = nearest_point(poses[:, :, 3], -poses[:, :, 2])
    distances = (poses[:, :, 3] - centre).norm(dim=-1)
    near, far = photographs.bounds or (float(distances.min()) / 2, float(distances.max()) * 1.5)
    half = (far - near) / 2 if half_size is None else half_size
    if not half > 0:
        raise DataError("the cameras do not tell how large the object is; set frame.half_size, in the data set's units")
    box = torch.stack([centre - half, centre + half]).float()
    return Frame(Placement(torch.eye(4)[:3], 1.0), box, near, far, unbounded=False)


def _without_end(photographs: Photographs) -> Frame:
    """The cameras' middle at the origin, their positions within [-1, 1], and rays that start before what is nearest."""
    placement = place(photographs.cameras.camera_to_worlds)
    cube = torch.tensor([[-1.0], [1.0]]).repeat(1, 3)
    frame = Frame(placement, cube, NEAR, FAR, unbounded=True)
    if photographs.points is not None:
        points = _exact(placement).points(photographs.points).float()
        near = nearest_shown(frame.placed(photographs.cameras), points)
    elif photographs.bounds is not None:
        near = BOUND_SHARE * photographs.bounds[0] * placement.scale
    else:
        near = NEAR
    return replace(frame, near=min(near, FAR / 2))


def _exact(placement: Placement) -> Placement:
    """In double precision: positions of a mapped scene may be millions of units from their origin."""
    return replace(placement, transform=placement.transform.double())


def dataset_of(photographs: Photographs, frame: Frame, masks: Masks) -> Dataset:
    """The photographs as a data set of the scene.

    Args:
        masks: what they say of pixels that they do not keep.
    Raises: DataError where a lens has no ray for any pixel.
    """
    parsed = ParsedScene(
        image_paths=photographs.paths,
        cameras=frame.placed(photographs.cameras),
        box=frame.box,
        near=frame.near,
        far=frame.far,
        transform=frame.placement.transform,
        scale=frame.placement.scale,
        unbounded=frame.unbounded,
        poses="photographs" if frame.unbounded else "exact",
    )
    return assemble(parsed, photographs.decoded, "train", masks)


def background_of(handed: Handed) -> Tensor:
    """(3,) what the data set's photographs are judged over; black where it does not say, as in nerfbaselines."""
    color = handed["metadata"].get("background_color")
    return torch.zeros(3) if color is None else torch.tensor(np.asarray(color).tolist()) / 255

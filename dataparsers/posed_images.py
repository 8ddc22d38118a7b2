"""Posed images as the files of a format describe them, and the flags that all such formats share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from torch import Tensor

from nerfloom import DataParser
from nerfloom.cameras.poses import Center, Orientation
from nerfloom.data.exposure import Taken
from nerfloom.data.scene import PoseSource
from nerfloom.data.tracks import Tracks


@dataclass(frozen=True)
class Captured(DataParser):
    """Flags of every format of posed images. Subclasses define `recognizes` and `parse`."""

    downscale_factor: int | None = None
    """Integer reduction factor of images; images that are reduced already are read from folders such as
    images_2. By default, the smallest power of two that reduces the longer side to at most 1600 pixels."""
    scale_factor: float = 1.0
    """Factor of camera positions, after automatic scaling."""
    scene_scale: float = 1.0
    """Half the side of the region of interest, a cube around the origin, scene units."""
    orientation_method: Orientation = "auto"
    """Up direction. up: the cameras' mean up direction; auto: the same, corrected for photographs that lie on their
    side; pca: the axis of least spread of the cameras' positions; none: unchanged."""
    center_method: Center = "poses"
    """Origin: the cameras' mean position (poses), the point that they look at (focus), or unchanged. No effect on data
    that states a region of interest (dtu, sdfstudio), which becomes the cube."""
    auto_scale_poses: bool = True
    """Scale camera positions to fit the cube from -1 to 1. If long lenses show less than half a scene unit around the
    point that most cameras look at, it is enlarged until they show one. No effect on data that states a region of
    interest."""
    placement: Path | None = None
    """dataparser_transforms.json of a run, ours or nerfstudio's. Its placement is used instead of all of these."""
    eval_interval: int = 8
    """Interval of held-out images, by sorted name, which are both val and test split; 0 holds out none."""
    near: float | None = None
    """Distance from a camera where the scene starts, scene units. If not given: half the distance of the nearest
    visible sparse points, or 0.05 without sparse points."""
    far: float = 1000.0
    """Distance from a camera where the scene ends, scene units."""
    poses: PoseSource = "photographs"
    """Source of the poses: exact, estimated from the images (photographs), or tracked by the device; methods may refine
    them accordingly."""


@dataclass(frozen=True)
class StatedRegion:
    """Region of interest that the input states, in its frame and units: a ball or a box."""

    center: Tensor
    """(3,) float64 centre."""
    half: Tensor
    """(3,) float64 half of the box's edges, which are parallel to the input's axes; of a ball, its radius."""
    is_ball: bool
    """Whether the region is a ball. The box around a ball has edges parallel to the scene's axes."""


@dataclass(frozen=True)
class Lenses:
    """Intrinsics of M images."""

    intrinsics: Tensor
    """(M, 4) float64 fx, fy, cx, cy in pixels of an image of `sizes`."""
    sizes: Tensor
    """(M, 2) int64 width and height that the intrinsics refer to, which may differ from the size of the image files."""
    model: str
    """Projection, a key of `LENSES`."""
    lens: Tensor | None
    """(M, K) distortion coefficients in the order of `LENSES[model]`; None if the projection has none."""


@dataclass(frozen=True)
class PosedImages:
    """M images of all splits as a format's files describe them, before any image file is read."""

    folder: Path
    """Parent of the images' folder; folders of reduced images are beside the latter."""
    paths: tuple[Path, ...]
    """M image files at full size; they may be missing if images reduced in advance exist."""
    names: tuple[str, ...]
    """M names that sort the images and decide which are held out."""
    poses: Tensor
    """(M, 3 or 4, 4) camera-to-world, OpenGL axes, in the input's frame and units; checked with `check_pose`."""
    intrinsics: Tensor
    """(M, 4) fx, fy, cx, cy in pixels of an image of `sizes`; for orthographic cameras, pixels per unit of the
    input."""
    sizes: Tensor
    """(M, 2) int64 width and height that the intrinsics refer to, which may differ from the size of the image files."""
    model: str = "pinhole"
    """Projection, a key of `LENSES`."""
    lens: Tensor | None = None
    """(M, K) distortion coefficients in the order of `LENSES[model]`; None if all are zero."""
    masks: tuple[Path | None, ...] | None = None
    """M mask files, white for pixels to train on; None for an image without mask."""
    depths: tuple[Path | None, ...] | None = None
    """M depth files; None for an image without depth."""
    times: Tensor | None = None
    """(M,) time of each image in [0, 1]; None for a static scene."""
    points: Tensor | None = None
    """(K, 3) sparse points in the input's frame; None for the points of `tracks`."""
    tracks: Tracks | None = None
    """Which images see which sparse points, in the input's frame; None if that is not known."""
    region: StatedRegion | None = None
    """Region of interest; None if the input states none. It places the scene, and holds the object that masks show."""
    taken: tuple[Taken, ...] | None = None
    """How each image was taken; None to read it from the images' EXIF."""

    def __getitem__(self, index: Tensor) -> PosedImages:
        """Return the images selected by an index tensor."""
        chosen = index.tolist()
        return replace(
            self,
            paths=tuple(self.paths[i] for i in chosen),
            names=tuple(self.names[i] for i in chosen),
            poses=self.poses[index],
            intrinsics=self.intrinsics[index],
            sizes=self.sizes[index],
            lens=None if self.lens is None else self.lens[index],
            masks=None if self.masks is None else tuple(self.masks[i] for i in chosen),
            depths=None if self.depths is None else tuple(self.depths[i] for i in chosen),
            times=None if self.times is None else self.times[index],
            tracks=None if self.tracks is None else self.tracks.of_images(index),
            taken=None if self.taken is None else tuple(self.taken[i] for i in chosen),
        )

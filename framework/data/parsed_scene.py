"""Data formats, and their result: images that are not decoded yet, with poses and properties of the scene."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

from torch import Tensor

from nerfloom.base.splits import Split
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.poses import Placement
from nerfloom.data.exposure import Taken
from nerfloom.data.scene import PoseSource
from nerfloom.data.tracks import Observations, Sightings


@dataclass(frozen=True)
class ParsedScene:
    """M images of one split, not decoded yet."""

    image_paths: tuple[Path, ...]
    """M image files."""
    cameras: Cameras
    """M cameras, for the stored sizes of the images."""
    box: Tensor
    """(2, 3) corners of the region of interest."""
    near: float
    """Distance from a camera where the scene starts."""
    far: float
    """Distance from a camera where the scene ends."""
    times: Tensor | None = None
    """(M,) time of each image in [0, 1]; None for a static scene."""
    transform: Tensor | None = None
    """(3, 4) float64 rigid transform from the input's frame to the scene's, applied before `scale`; None for the
    identity."""
    scale: float = 1.0
    """Scene units per unit of the input."""
    downscale_factor: int = 1
    """Integer reduction factor of images when they are loaded."""
    num_scales: int = 1
    """Number of sizes of each image in use: the loaded size, and then 1/2, 1/4, ... of it."""
    mask_paths: tuple[Path | None, ...] | None = None
    """M mask files, white for pixels to train on and black for others; None for an image without mask."""
    points: Tensor | None = None
    """(K, 3) sparse points on surfaces, scene coordinates."""
    observations: Observations | None = None
    """Which images see which of `points`, at known distances or not; None if unknown."""
    sightings: Sightings | None = None
    """Which images see which sparse points; None if unknown."""
    unbounded: bool = False
    """Whether there may be visible content outside `box`."""
    poses: PoseSource = "exact"
    """Source of the cameras' poses."""
    z_is_up: bool = False
    """Whether +z is up, as the data or their placement say; False if it is unknown."""
    appearance_varies: bool = False
    """Whether light, exposure or camera differ between images."""
    depth_paths: tuple[Path | None, ...] | None = None
    """M files of depth along the camera's axis, 0 where unknown; None for an image without depth."""
    depth_unit: float = 0.001
    """Units of the input per unit of a stored depth: 0.001 for an input in metres and depths in millimetres."""
    normal_paths: tuple[Path | None, ...] | None = None
    """M files of true normals in the input's axes, for evaluation; None for an image without normals."""
    light_paths: tuple[Path | None, ...] | None = None
    """M files of true diffuse light, for evaluation; None for an image without one."""
    object_distances: tuple[float, float] | None = None
    """Near and far for an object that lies in `box` and that masks cut out, so that masked-out pixels are background;
    None if masks only hide pixels."""
    scene_indices: Tensor | None = None
    """(M,) int64 index of the scene in each image; None if there is only one scene."""
    source_images: Tensor | None = None
    """(M,) bool, source images, which a method may render others from; they are not evaluated. None without."""
    taken: tuple[Taken, ...] | None = None
    """How each image was taken, its exposure and device; None to read it from the images' EXIF."""
    names: tuple[str, ...] | None = None
    """M names that distinguish the images of all splits; None if `image_paths` distinguish those of this split."""

    @property
    def placement(self) -> Placement:
        """Placement of the input in the scene."""
        return Placement.of(self.transform, self.scale)

    def __getitem__(self, index: Tensor) -> ParsedScene:
        """Return the images selected by an index tensor.

        Points that only other images see are left out. A point that no image is known to see stays.
        """
        chosen = index.tolist()
        points, observations = self.points, self.observations
        if points is not None and observations is not None:
            own = observations.of_images(index)
            kept = own.observed(len(points)) | ~observations.observed(len(points))
            points, observations = points[kept] if bool(kept.any()) else None, own.of_points(kept)
        return replace(
            self,
            image_paths=tuple(self.image_paths[i] for i in chosen),
            cameras=self.cameras[index],
            times=None if self.times is None else self.times[index],
            mask_paths=None if self.mask_paths is None else tuple(self.mask_paths[i] for i in chosen),
            depth_paths=None if self.depth_paths is None else tuple(self.depth_paths[i] for i in chosen),
            normal_paths=None if self.normal_paths is None else tuple(self.normal_paths[i] for i in chosen),
            light_paths=None if self.light_paths is None else tuple(self.light_paths[i] for i in chosen),
            points=points,
            observations=observations,
            sightings=None if self.sightings is None else self.sightings.of_images(index),
            scene_indices=None if self.scene_indices is None else self.scene_indices[index],
            source_images=None if self.source_images is None else self.source_images[index],
            taken=None if self.taken is None else tuple(self.taken[i] for i in chosen),
            names=None if self.names is None else tuple(self.names[i] for i in chosen),
        )


class DataParser(ABC):
    """A data format. Subclasses are frozen dataclasses with the format's flags as fields.

    A format that places a scene by all of its cameras should have the flag `placement: Path | None`: the
    dataparser_transforms.json of a run, to use that run's placement. A trained run passes its own placement if its
    images differ from those at training time.
    """

    interface: ClassVar[int] = 2
    """Version of the plugin interface that the format supports (`registry.INTERFACE`)."""

    @classmethod
    @abstractmethod
    def recognizes(cls, path: Path) -> bool:
        """Return whether the folder `path` looks like this format. Must be fast and must not raise."""

    @abstractmethod
    def parse(self, path: Path | None, split: Split) -> ParsedScene:
        """Read a `split` from the data folder `path`, or None if the user gave none.

        Raises:
            DataError: with the file and its problem.
        """

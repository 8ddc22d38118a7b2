"""Images with poses: what a data parser delivers, and what batches are drawn from."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import ClassVar, Literal

import torch
from torch import Tensor

from framework.base.console import say
from framework.base.errors import DataError
from framework.base.splits import Split as Split
from framework.cameras.cameras import Cameras
from framework.cameras.ndc import NdcCameras
from framework.cameras.view import View
from framework.data.coverage import pixels_with_rays
from framework.data.decoding import Decoded, ImageFiles, decode
from framework.data.depths import read_depths
from framework.data.image_files import image_size as image_size
from framework.data.image_files import one_line as one_line
from framework.data.image_files import read_image as read_image
from framework.data.image_files import reduce_image as reduce_image
from framework.data.light import APPEARANCE_STOPS, light_spread
from framework.data.mapped_pixels import MappedPixels
from framework.data.pixel_cache import PixelMemory
from framework.data.pixel_set import PixelSet
from framework.data.scene import PoseSource, Scene

Masks = Literal["auto", "ignored", "empty"]
"""What masks say of the pixels that they do not keep: nothing, or that nothing is there."""


@dataclass(frozen=True)
class ParsedScene:
    """M images of one split, still on disk."""

    image_paths: tuple[Path, ...]
    """M files."""
    cameras: Cameras
    """M cameras, with the sizes of the images as stored."""
    box: Tensor
    """(2, 3) corners of the part of space that matters."""
    near: float
    """Distance from a camera at which the scene may start."""
    far: float
    """Distance from a camera at which the scene ends."""
    times: Tensor | None = None
    """(M,) in [0, 1], for a moving scene."""
    transform: Tensor | None = None
    """(3, 4) from the input's frame to the scene's, applied before `scale`; the identity if None."""
    scale: float = 1.0
    """Scene units per unit of the input."""
    downscale_factor: int = 1
    """Images are reduced by this whole number when they are loaded."""
    mask_paths: tuple[Path | None, ...] | None = None
    """M images, white where a photograph is to be learnt from and black where it is not; None where there is none."""
    points: Tensor | None = None
    """(K, 3) sparse points on surfaces, scene coordinates."""
    unbounded: bool = False
    """There may be something to see outside `box`."""
    poses: PoseSource = "exact"
    """Where the cameras' poses come from."""
    appearance_varies: bool = False
    """Light, exposure or camera differ between the photographs."""
    depth_paths: tuple[Path | None, ...] | None = None
    """M images of depth along the camera's axis, 0 where it is unknown; None where there is none."""
    depth_unit: float = 0.001
    """Units of the input that a step of a depth image stands for: metres, of one in millimetres."""

    def __getitem__(self, index: Tensor) -> ParsedScene:
        """The images chosen by an index tensor."""
        chosen = index.tolist()
        return replace(
            self,
            image_paths=tuple(self.image_paths[i] for i in chosen),
            cameras=self.cameras[index],
            times=None if self.times is None else self.times[index],
            mask_paths=None if self.mask_paths is None else tuple(self.mask_paths[i] for i in chosen),
            depth_paths=None if self.depth_paths is None else tuple(self.depth_paths[i] for i in chosen),
        )


class DataParser(ABC):
    """A data format. Subclasses are frozen dataclasses whose fields are the format's flags."""

    interface: ClassVar[int] = 1
    """The version of the plugin interface it was written for (`registry.INTERFACE`)."""

    @classmethod
    @abstractmethod
    def recognizes(cls, path: Path) -> bool:
        """Whether the folder `path` looks like this format. Cheap, and never raises."""

    @abstractmethod
    def parse(self, path: Path | None, split: Split) -> ParsedScene:
        """Read one split.

        Args:
            path: the data folder, or None where the user named none.
            split: which images.
        Raises: DataError that says what is wrong with which file.
        """


@dataclass(frozen=True)
class Dataset:
    """M decoded images: uint8 until a batch is made, in memory or in a file."""

    pixels: Tensor
    """(P, 3) or (P, 4) uint8, image after image, row by row; the fourth channel is straight alpha."""
    cameras: Cameras
    """M cameras at the images' size."""
    times: Tensor | None
    """(M,) time of each image."""
    names: tuple[str, ...]
    """M file names, without folder."""
    scene: Scene
    """What methods are told."""
    transform: Tensor
    """(3, 4) from the input's frame to the scene's."""
    scale: float
    """Scene units per unit of the input."""
    drawn: PixelSet | None = None
    """Pixels that are worth drawing, counted through all images; None for all."""
    kept: PixelSet | None = None
    """Pixels that no mask ignores and a ray leads to; None for all."""
    opaque: PixelSet | None = None
    """What masks leave, where all that they cut away is empty: pixels that show nothing else have alpha 0."""
    light: Tensor | None = None
    """(M, 3, Q) `appearance.light_of` each image, where it is known; None of images with alpha of their own."""
    depths: Tensor | None = None
    """(P,) float16 depth of each pixel along its camera's axis, scene units, 0 where unknown; None for all."""
    mapped: MappedPixels | None = None
    """The file that `pixels` lie in, where they are too many for memory; they then stay on the processor."""

    def __len__(self) -> int:
        return len(self.cameras)

    @property
    def device(self) -> torch.device:
        """Where batches are made."""
        return self.cameras.fx.device

    def image(self, index: int) -> Tensor:
        """Image `index` as (H, W, 3 or 4) uint8, the fourth where the scene has alpha."""
        height, width = int(self.cameras.heights[index]), int(self.cameras.widths[index])
        start, end = self.cameras.offsets[index : index + 2].tolist()
        pixels = self.pixels[start:end]
        if self.mapped is not None:
            pixels = pixels.clone()
            self.mapped.drop(start, end)
        pixels = pixels.to(self.device)
        if self.opaque is not None:
            shown = self.opaque.mask(start, end)
            alpha = pixels[:, 3] * shown if pixels.shape[1] == 4 else shown * pixels.new_tensor(255)
            pixels = torch.cat([pixels[:, :3], alpha[:, None].to(torch.uint8)], dim=-1)
        return pixels.view(height, width, -1)

    def view(self, index: int, stride: int = 1) -> View:
        """Return the camera of image `index`, at its time.

        Args:
            index: which image.
            stride: only every so many-th row and column of its pixels.
        """
        return View.of(self.cameras, index, self.times, stride)

    def kept_of(self, index: int) -> Tensor | None:
        """(H, W) bool: which pixels of image `index` no mask ignores; None where no image has ignored ones."""
        if self.kept is None:
            return None
        start, end = self.cameras.offsets[index : index + 2].tolist()
        return self.kept.mask(start, end).view(int(self.cameras.heights[index]), -1)

    def drawing(self, pixels: PixelSet) -> Dataset:
        """The same data, of which only these pixels are drawn, as far as they were until now; all of those if none."""
        pixels = pixels.to(self.pixels.device)
        if self.drawn is not None:
            pixels = PixelSet.shared([pixels, self.drawn], 2)
        if not len(pixels):
            return self
        return replace(self, drawn=pixels if self.mapped is not None else pixels.listed())

    def to(self, device: torch.device | str) -> Dataset:
        """The same data on `device`."""
        return replace(
            self,
            pixels=self.pixels if self.mapped is not None else self.pixels.to(device),
            cameras=self.cameras.to(device),
            times=None if self.times is None else self.times.to(device),
            drawn=self.drawn if self.drawn is None or self.mapped is not None else self.drawn.to(device),
            kept=None if self.kept is None else self.kept.to(device),
            opaque=None if self.opaque is None else self.opaque.to(device),
            depths=None if self.depths is None else self.depths.to(device),
        )


def existing(paths: Sequence[Path], split: str) -> Tensor:
    """Indices of the files that exist; the missing ones are reported once, by count and first name.

    Raises: DataError where none exists.
    """
    missing = [path for path in paths if not path.is_file()]
    if len(missing) == len(paths):
        first = f"; the first would be {missing[0]}" if missing else ""
        raise DataError(f"split '{split}' has no image: its data lists {len(paths)}, of which none exists{first}")
    if missing:
        say(f"split '{split}': {len(missing)} of {len(paths)} images are missing and skipped, the first {missing[0]}")
    return torch.tensor([index for index, path in enumerate(paths) if path.is_file()])


def load_dataset(
    parsed: ParsedScene, split: str, memory: PixelMemory | None = None, masks: Masks = "ignored"
) -> Dataset:
    """Decode the images of a split.

    Unreadable images are skipped and reported; an image whose size is not its camera's is an error.

    Args:
        memory: how much may be held in memory; half of the machine's if None.
        masks: what they say of the pixels that they do not keep; auto: as `cuts_out` finds.
    Raises: DataError for a size that does not fit, or where no image is left.
    """
    factor = parsed.downscale_factor
    cameras = parsed.cameras if factor == 1 else parsed.cameras.scaled(1 / factor)
    sizes = tuple(zip(cameras.widths.tolist(), cameras.heights.tolist(), strict=True))
    mask_paths = parsed.mask_paths or (None,) * len(parsed.image_paths)
    files = ImageFiles(split, parsed.image_paths, mask_paths, sizes, factor)
    decoded = decode(files, memory or PixelMemory.of())
    parsed = replace(parsed, cameras=cameras, downscale_factor=1)
    return assemble(parsed if len(decoded.left) == len(sizes) else parsed[decoded.left], decoded, split, masks)


def assemble(parsed: ParsedScene, decoded: Decoded, split: str, masks: Masks = "ignored") -> Dataset:
    """A data set of images whose pixels are there already (`decoding.from_arrays`).

    Args:
        parsed: what else is known of those images, the cameras being at their size. Of its files only depth images are
            read; of the others, which need not exist, the names are kept.
        decoded: their pixels.
        split: what to call them in messages.
        masks: what they say of the pixels that they do not keep; auto: as `cuts_out` finds.
    Raises: DataError where a lens has no ray for any pixel, or a depth image cannot be used.
    """
    cameras = parsed.cameras
    kept, opaque, light = decoded.kept, None, None if decoded.pixels.shape[1] == 4 else decoded.light
    if kept is not None and (masks == "empty" or (masks == "auto" and cuts_out(kept, cameras))):
        kept, opaque = None, kept
    scene = Scene(
        box=parsed.box,
        near=parsed.near,
        far=parsed.far,
        num_cameras=len(cameras),
        has_alpha=opaque is not None or decoded.pixels.shape[1] == 4,
        moving=parsed.times is not None,
        image_size=int(torch.maximum(cameras.widths, cameras.heights).max()),
        unbounded=parsed.unbounded,
        poses=parsed.poses,
        warped=isinstance(cameras, NdcCameras),
        has_depth=parsed.depth_paths is not None and decoded.mapped is None,
        # Of an object cut out of its surroundings, each side has a light of its own.
        appearance_varies=parsed.appearance_varies or (light is not None and light_spread(light) > APPEARANCE_STOPS),
        camera_to_worlds=cameras.camera_to_worlds,
    )
    depths = _depths(parsed, cameras, decoded.mapped is not None)
    names = tuple(path.name for path in parsed.image_paths)
    reached = pixels_with_rays(cameras, names, split)
    if reached is not None:
        kept = reached if kept is None else PixelSet.shared([kept, reached], 2)
        if not len(kept):
            raise DataError(f"split '{split}': masks leave only pixels that the lens has no ray for")
    return Dataset(
        pixels=decoded.pixels,
        cameras=cameras,
        times=parsed.times,
        names=names,
        scene=scene,
        transform=torch.eye(4)[:3] if parsed.transform is None else parsed.transform,
        scale=parsed.scale,
        drawn=kept if kept is None or decoded.mapped is not None else kept.listed(),
        kept=kept,
        opaque=opaque,
        light=light,
        depths=depths,
        mapped=decoded.mapped,
    )


def cuts_out(kept: PixelSet, cameras: Cameras) -> bool:
    """Whether masks look as if they cut an object out of its surroundings, rather than hide what disturbs.

    They ignore more than half of all pixels, and not the same ones of every photograph, as the rim of a lens would be.
    """
    ends = cameras.offsets.tolist()
    if len(kept) > ends[-1] / 2:
        return False
    first = kept.mask(0, ends[1])
    return any(not torch.equal(kept.mask(start, end), first) for start, end in pairwise(ends))


def _depths(parsed: ParsedScene, cameras: Cameras, in_file: bool) -> Tensor | None:
    if parsed.depth_paths is None:
        return None
    if in_file:
        say("the depth images are not used, as the photographs are too many for memory")
        return None
    return read_depths(parsed.depth_paths, cameras, parsed.depth_unit * parsed.scale)

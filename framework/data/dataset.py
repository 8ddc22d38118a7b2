"""Images with poses: the data set that batches are drawn from, and its construction from a parsed scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from nerfloom.base.console import say
from nerfloom.base.errors import DataError
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.ndc import NdcCameras
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.view import View
from nerfloom.data.coverage import pixels_with_rays
from nerfloom.data.decoding import Decoded, ImageFiles, decode
from nerfloom.data.depths import read_depths
from nerfloom.data.diffuse_light import read_diffuse
from nerfloom.data.exposure import devices_of, exposures_of, read_taken
from nerfloom.data.light_spread import APPEARANCE_STOPS, light_spread
from nerfloom.data.motion_bound import MotionBound
from nerfloom.data.names_on_disk import are_files, distinct_names, nearest_on_disk
from nerfloom.data.normals import read_normals
from nerfloom.data.parsed_scene import ParsedScene
from nerfloom.data.pixels.cache import PixelMemory
from nerfloom.data.pixels.memory_mapped import MappedPixels
from nerfloom.data.pixels.pixel_set import PixelSet
from nerfloom.data.scene import Scene
from nerfloom.data.sparse_depth import SparseDepth, sparse_depth

Masks = Literal["auto", "ignored", "empty", "off"]
"""Meaning of masked-out pixels. ignored: unknown content. empty: background. off: as any others, masks are not read."""


@dataclass(frozen=True)
class Dataset:
    """M decoded images, stored as uint8 in memory or in a file."""

    pixels: Tensor
    """(P, 3) or (P, 4) uint8 pixels, image after image, row by row; the fourth channel is straight alpha."""
    cameras: Cameras
    """M cameras, for the sizes of the decoded images."""
    times: Tensor | None
    """(M,) time of each image; None for a static scene."""
    paths: tuple[Path, ...]
    """M image files. Images in memory have names only."""
    scene: Scene
    """Description of the scene for methods."""
    transform: Tensor
    """(3, 4) float64 on the CPU, from the input's frame to the scene's."""
    scale: float
    """Scene units per unit of the input."""
    drawn: PixelSet | None = None
    """Pixels that batches are drawn from, counted over all images; None for all."""
    kept: PixelSet | None = None
    """Pixels that have a ray and are not masked out; None for all."""
    opaque: PixelSet | None = None
    """Pixels that masks keep, if masked-out pixels are empty, with alpha 0; otherwise None."""
    light: Tensor | None = None
    """(M, 3, Q) `light_spread.light_of` each image; None if unknown, or if images have an alpha channel."""
    depths: Tensor | None = None
    """(P,) float16 depth of each pixel along its camera's axis, scene units, 0 where unknown; None if there are
    none."""
    mapped: MappedPixels | None = None
    """The file of `pixels`, if they exceed the memory limit; they then stay on the CPU."""
    points: Tensor | None = None
    """(K, 3) sparse points on surfaces, scene coordinates; None if there are none."""
    sparse_depth: SparseDepth | None = None
    """Pixels where images see sparse points, and their distances; None if there are none."""
    reductions: Tensor | None = None
    """(M,) int64 reduction factor of each image relative to full size, if images are used at several sizes."""
    scene_indices: Tensor | None = None
    """(M,) int64 on the CPU, index of the scene in each image; None if there is only one scene."""
    source_images: Tensor | None = None
    """(M,) bool on the CPU, source images, for rendering others; they are not evaluated. None without."""
    training: bool = False
    """Whether these are training images, in the order of a model's vectors for them."""
    normal_paths: tuple[Path | None, ...] | None = None
    """M files of true normals, read when asked for; None if there are none."""
    light_paths: tuple[Path | None, ...] | None = None
    """M files of true diffuse light, read when asked for; None if there are none."""
    given_names: tuple[str, ...] | None = None
    """M names of the images as the whole data has them; None if `paths` are all."""
    motion_bound: MotionBound | None = None
    """Distance that matter may move, on the CPU, estimated from the images; None if unknown or not needed."""

    def __len__(self) -> int:
        return len(self.cameras)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """M file names, with as many folders as distinguish all files of the data."""
        return distinct_names(self.paths) if self.given_names is None else self.given_names

    @property
    def placement(self) -> Placement:
        """Placement of the input in the scene."""
        return Placement.of(self.transform, self.scale)

    @cached_property
    def image_weights(self) -> Tensor | None:
        """(M,) weight of each image's pixels in a loss, if images have several sizes; the mean over all pixels is 1.

        A pixel of an image reduced by s stands for s^2 pixels: Mip-NeRF (Barron et al. 2021), section 4.
        """
        if self.reductions is None:
            return None
        areas = self.reductions.float().square()
        counts = (self.cameras.widths * self.cameras.heights).to(areas)
        return areas * (counts.sum() / (areas * counts).sum())

    @property
    def device(self) -> torch.device:
        """The device of batches."""
        return self.cameras.fx.device

    @property
    def resident(self) -> bool:
        """True if `pixels` are in memory, on the device of batches."""
        return self.mapped is None and self.pixels.device == self.device

    def stored(self, flat: Tensor) -> Tensor:
        """Return the stored colours of pixels, on the device of batches.

        Args:
            flat: (R,) numbers of the pixels, counted over all images, on any device.

        Returns:
            (R, 3 or 4) uint8.
        """
        flat = flat.to(self.pixels.device)
        return (self.pixels[flat] if self.mapped is None else self.mapped.look_up(flat)).to(self.device)

    def image(self, index: int) -> Tensor:
        """Return image `index` as (H, W, 3 or 4) uint8, with alpha if the scene has it."""
        height, width = self.cameras.sizes[index]
        start, end = self.cameras.ends[index : index + 2]
        pixels = self.pixels[start:end]
        if self.mapped is not None:
            pixels = pixels.clone()
            self.mapped.drop(start, end)
        pixels = pixels.to(self.device)
        if self.opaque is not None:
            opaque = self.opaque.mask(start, end)
            alpha = pixels[:, 3] * opaque if pixels.shape[1] == 4 else opaque * pixels.new_tensor(255)
            pixels = torch.cat([pixels[:, :3], alpha[:, None].to(torch.uint8)], dim=-1)
        return pixels.view(height, width, -1)

    def view(self, index: int, stride: int = 1) -> View:
        """Return the camera of image `index` with time and scene, at every `stride`-th row and column."""
        view = replace(View.of(self.cameras, index, self.times, stride), image=index if self.training else None)
        return view if self.scene_indices is None else replace(view, scene=int(self.scene_indices[index]))

    def kept_of(self, index: int) -> Tensor | None:
        """Return the pixels of image `index` that are kept, (H, W) bool, or None if all pixels of the data set are."""
        if self.kept is None:
            return None
        start, end = self.cameras.offsets[index : index + 2].tolist()
        return self.kept.mask(start, end).view(int(self.cameras.heights[index]), -1)

    def normals_of(self, index: int) -> Tensor | None:
        """Return the true normals of image `index`, (H, W, 3) unit vectors in scene coordinates; None if unknown.

        Raises:
            DataError: if the file is invalid.
        """
        path = None if self.normal_paths is None else self.normal_paths[index]
        if path is None:
            return None
        height, width = self.cameras.sizes[index]
        turn = self.transform[:, :3].to(self.device, torch.float32)
        return read_normals(path, width, height).to(self.device) @ turn.T

    def diffuse_of(self, index: int) -> Tensor | None:
        """Return the true diffuse light of image `index`, (H, W, 3) linear; None if unknown.

        Raises:
            DataError: if the file is invalid.
        """
        path = None if self.light_paths is None else self.light_paths[index]
        if path is None:
            return None
        height, width = self.cameras.sizes[index]
        return read_diffuse(path, width, height).to(self.device)

    def drawing(self, pixels: PixelSet) -> Dataset:
        """Return the data set with `drawn` restricted to `pixels`; unchanged if that would leave none."""
        pixels = pixels.to(self.pixels.device)
        if self.drawn is not None:
            pixels = PixelSet.shared([pixels, self.drawn], 2)
        if not len(pixels):
            return self
        return replace(self, drawn=pixels if self.mapped is not None else pixels.listed())

    def to(self, device: torch.device | str, with_pixels: bool = True) -> Dataset:
        """Return the data set with batches on `device`; without `with_pixels`, drawn pixels are copied there."""
        with_pixels = with_pixels and self.mapped is None
        return replace(
            self,
            pixels=self.pixels.to(device) if with_pixels else self.pixels,
            cameras=self.cameras.to(device),
            times=None if self.times is None else self.times.to(device),
            drawn=self.drawn.to(device) if self.drawn is not None and with_pixels else self.drawn,
            kept=None if self.kept is None else self.kept.to(device),
            opaque=None if self.opaque is None else self.opaque.to(device),
            depths=None if self.depths is None else self.depths.to(device),
            sparse_depth=None if self.sparse_depth is None else self.sparse_depth.to(device),
            reductions=None if self.reductions is None else self.reductions.to(device),
        )


def existing_files(paths: Sequence[Path], split: str) -> Tensor:
    """Return the indices of `paths` that exist, and report the number and first of the others of a `split`.

    Raises:
        DataError: if no file exists.
    """
    there = are_files(paths)
    missing = [path for path, exists in zip(paths, there, strict=True) if not exists]
    if len(missing) == len(paths):
        first = f"; the first is {missing[0]}: {nearest_on_disk(missing[0])}" if missing else ""
        raise DataError(
            f"split '{split}' has no image: none of the {len(paths)} files listed in the data exists{first}"
        )
    if missing:
        say(f"split '{split}': {len(missing)} of {len(paths)} images are missing and skipped, the first {missing[0]}")
    return torch.tensor([index for index, exists in enumerate(there) if exists])


def load_dataset(
    parsed: ParsedScene, split: str, memory: PixelMemory | None = None, masks: Masks = "ignored"
) -> Dataset:
    """Decode the images of a split.

    Unreadable images are skipped and reported.

    Args:
        parsed: output of a data parser.
        split: name of the split in messages.
        memory: memory limit and cache folder; if None, half of the machine's memory and the user's cache folder.
        masks: meaning of masked-out pixels; auto: empty if the format says so, otherwise decided by `cuts_out`.

    Raises:
        DataError: if an image's size differs from its camera's, no image is readable, or the scene's distances are
            invalid.
    """
    if not 0 <= parsed.near < parsed.far < math.inf:
        raise DataError(
            f"split '{split}': near is {parsed.near} and far is {parsed.far}; --near must be at least 0 and less than "
            "--far, which must be finite"
        )
    if masks == "off":
        parsed = replace(parsed, mask_paths=None)
    count = len(parsed.image_paths)
    reductions = 2 ** torch.arange(parsed.num_scales).repeat_interleave(count)  # all images at one size, then the next
    if parsed.num_scales > 1:
        parsed = parsed[torch.arange(count).repeat(parsed.num_scales)]
    factors = parsed.downscale_factor * reductions
    cameras = parsed.cameras if int(factors.max()) == 1 else parsed.cameras.scaled(1 / factors)
    sizes = tuple(zip(cameras.widths.tolist(), cameras.heights.tolist(), strict=True))
    mask_paths = parsed.mask_paths or (None,) * len(parsed.image_paths)
    files = ImageFiles(split, parsed.image_paths, mask_paths, sizes, tuple(factors.tolist()))
    decoded = decode(files, memory or PixelMemory.of())
    several = parsed.num_scales > 1
    parsed = replace(parsed, cameras=cameras, downscale_factor=1, num_scales=1)
    parsed = parsed if len(decoded.left) == len(sizes) else parsed[decoded.left]
    if parsed.taken is None and split == "train":
        parsed = replace(parsed, taken=read_taken(parsed.image_paths))
    dataset = assemble(parsed, decoded, split, masks)
    return replace(dataset, reductions=reductions[decoded.left]) if several else dataset


def assemble(parsed: ParsedScene, decoded: Decoded, split: str, masks: Masks = "ignored") -> Dataset:
    """Construct a data set from decoded images.

    Args:
        parsed: the scene of these images, with cameras for their decoded sizes. Of its files only depths are read.
        decoded: the pixels (`decoding.decode` or `decoding.from_arrays`).
        split: name of the split in messages.
        masks: meaning of masked-out pixels; auto: empty if the format says so, otherwise decided by `cuts_out`.

    Raises:
        DataError: if no pixel has a ray, or a depth image is invalid.
    """
    cameras, light = parsed.cameras, None if decoded.pixels.shape[1] == 4 else decoded.light
    parsed, kept, opaque = _with_masks(parsed, None if masks == "off" else decoded.kept, masks)
    visible = pixels_with_rays(cameras, tuple(path.name for path in parsed.image_paths), split)
    if visible is not None:
        kept = visible if kept is None else PixelSet.shared([kept, visible], 2)
        if not len(kept):
            raise DataError(f"split '{split}': the masks keep only pixels without a ray through the lens")
    sparse = _sparse_depth(parsed, cameras, kept if opaque is None else opaque)
    scene = Scene(
        box=parsed.box,
        near=parsed.near,
        far=parsed.far,
        num_cameras=len(cameras),
        has_alpha=opaque is not None or decoded.pixels.shape[1] == 4,
        moving=parsed.times is not None,
        image_size=int(torch.maximum(cameras.widths, cameras.heights).max()),
        unbounded=parsed.unbounded,
        z_is_up=parsed.z_is_up,
        poses=parsed.poses,
        warped=isinstance(cameras, NdcCameras),
        has_depth=parsed.depth_paths is not None and decoded.mapped is None,
        appearance_varies=parsed.appearance_varies or _light_differs(light, cameras),
        camera_to_worlds=cameras.camera_to_worlds,
        image_pixels=int(cameras.offsets[-1]) // len(cameras),
        num_sparse_depths=0 if sparse is None else len(sparse),
        num_times=0 if parsed.times is None else len(parsed.times.unique()),
        num_scenes=1 if parsed.scene_indices is None else len(parsed.scene_indices.unique()),
        exposures=exposures_of(parsed.taken),
        devices=devices_of(parsed.taken, cameras),
    )
    return Dataset(
        pixels=decoded.pixels,
        cameras=cameras,
        times=parsed.times,
        paths=parsed.image_paths,
        scene=scene,
        transform=parsed.placement.transform,
        scale=parsed.scale,
        drawn=kept if kept is None or decoded.mapped is not None else kept.listed(),
        kept=kept,
        opaque=opaque,
        light=light,
        depths=_depths(parsed, cameras, decoded.mapped is not None),
        mapped=decoded.mapped,
        points=parsed.points,
        sparse_depth=sparse,
        scene_indices=parsed.scene_indices,
        source_images=parsed.source_images,
        training=split == "train",
        normal_paths=parsed.normal_paths,
        light_paths=parsed.light_paths,
        given_names=parsed.names,
    )


def _light_differs(light: Tensor | None, cameras: Cameras) -> bool:
    """Return whether light changes between images. It is None for a cut-out object: each side is lit differently."""
    return light is not None and light_spread(light, cameras.camera_to_worlds) > APPEARANCE_STOPS


def _with_masks(
    parsed: ParsedScene, kept: PixelSet | None, masks: Masks
) -> tuple[ParsedScene, PixelSet | None, PixelSet | None]:
    """Return the scene, its kept pixels and its opaque pixels, according to the meaning of masks.

    If masks show the object, the scene ends at the object's box.
    """
    shown = parsed.object_distances
    if kept is None or masks in ("ignored", "off"):
        return parsed, kept, None
    if masks == "auto" and shown is None and not cuts_out(kept, parsed.cameras):
        return parsed, kept, None
    return parsed if shown is None else replace(parsed, near=shown[0], far=shown[1], unbounded=False), None, kept


def cuts_out(kept: PixelSet, cameras: Cameras) -> bool:
    """Return whether masks cut an object out of its surroundings, instead of hiding parts of the images.

    This is the case if they remove more than half of all pixels, and not the same pixels of every image (a lens rim).

    Args:
        kept: pixels that the masks keep.
        cameras: cameras of the images.
    """
    ends = cameras.offsets.tolist()
    if len(kept) > ends[-1] / 2:
        return False
    first = kept.mask(0, ends[1])
    return any(not torch.equal(kept.mask(start, end), first) for start, end in pairwise(ends))


def _sparse_depth(parsed: ParsedScene, cameras: Cameras, shown: PixelSet | None) -> SparseDepth | None:
    """Return the pixels in `shown` (None for all) where images see sparse points; None if there are none."""
    if parsed.sightings is None or isinstance(cameras, NdcCameras):
        return None
    found = sparse_depth(parsed.sightings, cameras)
    if shown is not None:
        found = found[shown.contains(found.pixels)]
    return found if len(found) else None


def _depths(parsed: ParsedScene, cameras: Cameras, in_file: bool) -> Tensor | None:
    if parsed.depth_paths is None:
        return None
    if in_file:
        say("the depth images are not used, because the images exceed the memory limit")
        return None
    return read_depths(parsed.depth_paths, cameras, parsed.depth_unit * parsed.scale)

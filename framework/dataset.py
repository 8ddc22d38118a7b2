"""Images with poses: what a data parser delivers, and how it is kept in memory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import imageio.v3 as iio
import numpy as np
import torch
from torch import Tensor

from framework.cameras import Cameras
from framework.console import say, track
from framework.errors import DataError
from framework.scene import Scene

Split = Literal["train", "val", "test"]


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
    exact_poses: bool = True
    """The poses are known rather than estimated."""
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
    """M decoded images: uint8 until a batch is made."""

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
    drawn: Tensor | None = None
    """(K,) int64 pixels that are worth drawing, counted through all images; None for all."""

    def __len__(self) -> int:
        return len(self.cameras)

    def image(self, index: int) -> Tensor:
        """Image `index` as (H, W, 3 or 4) uint8."""
        height, width = int(self.cameras.heights[index]), int(self.cameras.widths[index])
        start = int(self.cameras.offsets[index])
        return self.pixels[start : start + height * width].view(height, width, -1)

    def to(self, device: torch.device | str) -> Dataset:
        """The same data on `device`."""
        return replace(
            self,
            pixels=self.pixels.to(device),
            cameras=self.cameras.to(device),
            times=None if self.times is None else self.times.to(device),
            drawn=None if self.drawn is None else self.drawn.to(device),
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


def image_size(paths: Sequence[Path]) -> tuple[int, int]:
    """Width and height of the first of some image files that can be read, from its header.

    Raises: DataError where none can be read.
    """
    reason = ""
    for path in paths:
        try:
            height, width = iio.improps(path, plugin="pillow").shape[:2]
            return width, height
        except Exception as error:  # whatever the decoder raises, as in `read_image`
            reason = reason or f"{path} is not a readable image: {one_line(error)}"
    raise DataError(reason or "there is no image to read a size from")


def load_dataset(parsed: ParsedScene, split: str) -> Dataset:
    """Decode the images of a split.

    Unreadable images are skipped and reported; an image whose size is not its camera's is an error.

    Raises: DataError for a size that does not fit, or where no image is left.
    """
    factor = parsed.downscale_factor
    with ThreadPoolExecutor() as pool:
        jobs = pool.map(lambda path: _try_read(path, factor), parsed.image_paths)
        images = list(track(jobs, f"Loading {split} images", total=len(parsed.image_paths)))
    failures = [image for image in images if isinstance(image, DataError)]
    if len(failures) == len(images):
        raise DataError(f"split '{split}' has no readable image: {failures[0]}" if failures else f"'{split}' is empty")
    if failures:
        say(f"split '{split}': {len(failures)} of {len(images)} images are unreadable and skipped: {failures[0]}")
        parsed = parsed[torch.tensor([i for i, image in enumerate(images) if not isinstance(image, DataError)])]
    decoded = [image for image in images if not isinstance(image, DataError)]

    cameras = parsed.cameras if factor == 1 else parsed.cameras.scaled(1 / factor)
    for image, path, width, height in zip(
        decoded, parsed.image_paths, cameras.widths.tolist(), cameras.heights.tolist(), strict=True
    ):
        if image.shape[:2] != (height, width):
            found = f"{image.shape[1] * factor}x{image.shape[0] * factor}"
            raise DataError(f"{path} is {found} pixels, but its camera is for {width * factor}x{height * factor}")
    return _assemble(parsed, decoded, cameras)


def _assemble(parsed: ParsedScene, images: list[np.ndarray], cameras: Cameras) -> Dataset:
    has_alpha = any((image[..., 3] != 255).any() for image in images)
    channels = 4 if has_alpha else 3
    pixels = np.concatenate([image[..., :channels].reshape(-1, channels) for image in images])
    scene = Scene(
        box=parsed.box,
        near=parsed.near,
        far=parsed.far,
        num_cameras=len(images),
        has_alpha=has_alpha,
        moving=parsed.times is not None,
        image_size=max(max(image.shape[:2]) for image in images),
        unbounded=parsed.unbounded,
        exact_poses=parsed.exact_poses,
        appearance_varies=parsed.appearance_varies,
    )
    transform = torch.eye(4)[:3] if parsed.transform is None else parsed.transform
    names = tuple(path.name for path in parsed.image_paths)
    return Dataset(torch.from_numpy(pixels), cameras, parsed.times, names, scene, transform, parsed.scale)


def _try_read(path: Path, factor: int) -> np.ndarray | DataError:
    try:
        return read_image(path, factor)
    except DataError as error:
        return error


def read_image(path: Path, factor: int = 1) -> np.ndarray:
    """An 8-bit image as (H, W, 4) uint8 with straight alpha, reduced by a whole number.

    Raises: DataError where it cannot be decoded or has more than 8 bits a channel.
    """
    try:
        mode = str(iio.immeta(path, plugin="pillow").get("mode", ""))
        if mode.startswith(("I", "F")) or _is_deep_png(path):
            raise DataError(f"{path} has more than 8 bits a channel; convert it to an 8-bit PNG")
        image = np.asarray(iio.imread(path, plugin="pillow", mode="RGBA"))
    except DataError:
        raise
    except Exception as error:  # Pillow raises OSError, SyntaxError, struct.error, DecompressionBombError and more
        raise DataError(f"{path} is not a readable image: {one_line(error)}") from error
    return image if factor == 1 else reduce_image(image, factor)


def _is_deep_png(path: Path) -> bool:
    """Whether a PNG has 16 bits a channel, which Pillow would cut to 8 without a word (bit depth: byte 24)."""
    with path.open("rb") as file:
        head = file.read(25)
    return head[:8] == b"\x89PNG\r\n\x1a\n" and head[24:] == b"\x10"


def reduce_image(image: np.ndarray, factor: int) -> np.ndarray:
    """Box filter by a whole number: (H, W, 4) uint8 to (H // factor, W // factor, 4).

    Colours are averaged weighted by alpha, so that transparent pixels lend none of theirs.
    """
    height, width = image.shape[0] // factor, image.shape[1] // factor
    if height == 0 or width == 0:
        size = f"{image.shape[1]}x{image.shape[0]}"
        raise DataError(f"an image of {size} pixels has none left at --downscale-factor {factor}")
    blocks = image[: height * factor, : width * factor].reshape(height, factor, width, factor, 4).astype(np.float64)
    alpha = blocks[..., 3:].sum((1, 3))
    color = (blocks[..., :3] * blocks[..., 3:]).sum((1, 3)) / np.maximum(alpha, 1)
    return np.concatenate([color, alpha / factor**2], axis=-1).round().astype(np.uint8)


def one_line(error: BaseException) -> str:
    """The first line of an error's message, or its type's name."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]

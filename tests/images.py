"""Sets of images for tests: written fast, of any size, with cameras that do not matter."""

from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch

from nerfloom.cameras.cameras import Cameras
from nerfloom.data.parsed_scene import ParsedScene


def noise(width: int, height: int, seed: int, channels: int = 3) -> np.ndarray:
    """(H, W, C) uint8; probably no two pixels are the same."""
    return np.random.default_rng(seed).integers(0, 256, (height, width, channels), dtype=np.uint8)


def parsed(paths: list[Path], sizes: list[tuple[int, int]], masks: list[Path | None] | None = None) -> ParsedScene:
    """Images of the given widths and heights."""
    widths, heights = torch.tensor(sizes).T
    ones = torch.ones(len(paths))
    cameras = Cameras(torch.eye(4)[:3].repeat(len(paths), 1, 1), ones, ones, ones, ones, widths, heights)
    box = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])
    return ParsedScene(tuple(paths), cameras, box, 0.1, 2.0, mask_paths=None if masks is None else tuple(masks))


def write_noise(folder: Path, sizes: list[tuple[int, int]], channels: int = 3, suffix: str = ".bmp") -> ParsedScene:
    """Images of noise, the first having seed 0."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{index:03d}{suffix}" for index in range(len(sizes))]
    for index, (path, size) in enumerate(zip(paths, sizes, strict=True)):
        iio.imwrite(path, noise(*size, index, channels))
    return parsed(paths, sizes)


def write_mask(path: Path, used: np.ndarray) -> Path:
    """A mask that is white where `used` (H, W) bool."""
    iio.imwrite(path, np.where(used, 255, 0).astype(np.uint8))
    return path

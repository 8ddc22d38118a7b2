"""Gaussians in glTF files (.glb), as points with the extension KHR_gaussian_splatting, for other programs.

https://github.com/KhronosGroup/glTF (extensions/2.0/Khronos/KHR_gaussian_splatting/README.md, 2026) specifies the
extension. A primitive of points has one attribute each, of float32:

    POSITION                                          centres
    KHR_gaussian_splatting:ROTATION                   unit quaternions x, y, z, w
    KHR_gaussian_splatting:SCALE                      standard deviations, not their logarithms
    KHR_gaussian_splatting:OPACITY                    0 to 1, after the sigmoid
    KHR_gaussian_splatting:SH_DEGREE_l_COEF_n         red, green and blue of a coefficient of degree l; n = l + m
    COLOR_0                                           16 bits, linear light: colours of points for other programs

Harmonics have the signs of PLY files (Condon-Shortley phase) and are evaluated at the direction from the camera to the
Gaussian. The kernel is `ellipse`. Colours are `srgb_rec709_display`: they are blended as they are stored. The extension
has one projection, perspective, and one way of sorting, by distance. It has no words for antialiasing and blur; the
settings of `nerfloom.splats.look` are in `extras`, which other programs skip.

In glTF, y is up. The Gaussians must be given so (`Placement.y_up`).
"""

from __future__ import annotations

import numpy as np
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.data.glb import glb_bytes
from nerfloom.kernels.color import to_linear
from nerfloom.kernels.splats.project import BLUR, DC
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import OURS, Look, comments

EXTENSION = "KHR_gaussian_splatting"
MAX_LOG_SCALE = 88.0
"""Maximum logarithm of a standard deviation: its exponential is finite in float32."""
POINTS = 0
"""Number of the kind of primitive in glTF."""


def encoded_glb(gaussians: Gaussians, look: Look = OURS) -> tuple[bytes, list[str]]:
    """Return the content of a GLB file, and sentences about facts that other programs cannot read from it.

    All numbers are float32, so nothing is rounded beyond it.

    Args:
        gaussians: N finite Gaussians on the CPU, in a frame with y up.

    Raises:
        ConfigError: if there are none, or the file would be larger than 4 GiB.
    """
    if not len(gaussians):
        raise ConfigError("a glTF file holds at least one Gaussian, and there is none")
    splatting = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
        "extras": {"comments": comments(look)},
    }
    primitive = {"mode": POINTS, "extensions": {EXTENSION: splatting}}
    content = {"extensionsUsed": [EXTENSION]}
    return glb_bytes("Gaussians", _attributes(gaussians), primitive, content), _unsaid(look)


def _attributes(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Return the attributes (N, 1, 3 or 4), by name; positions are the first."""
    rotations = gaussians.rotations.double()
    rotations = rotations / rotations.norm(dim=-1, keepdim=True).clamp(min=1e-300)
    opacity = gaussians.logits.double().sigmoid()[:, None].numpy()
    linear = to_linear((0.5 + DC * gaussians.colors.double()).clamp(0, 1)).numpy()
    found = {
        "POSITION": _float(gaussians.means),
        f"{EXTENSION}:ROTATION": _float(rotations[:, [1, 2, 3, 0]]),
        f"{EXTENSION}:SCALE": _float(gaussians.log_scales.double().clamp(max=MAX_LOG_SCALE).exp()),
        f"{EXTENSION}:OPACITY": opacity.astype(np.float32),
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": _float(gaussians.colors),
    }
    for degree in range(1, gaussians.degree + 1):
        for order in range(2 * degree + 1):
            coefficient = gaussians.harmonics[:, :, degree**2 - 1 + order]
            found[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"] = _float(coefficient)
    found["COLOR_0"] = np.rint(65535 * np.concatenate([linear, opacity], -1)).astype(np.uint16)
    return found


def _float(values: Tensor) -> np.ndarray:
    return np.ascontiguousarray(values.float().numpy())


def _unsaid(look: Look) -> list[str]:
    """Return sentences about settings of drawing that the extension has no words for."""
    words = []
    if look.antialiased:
        words.append("that they were trained with antialiasing")
    if look.blur != BLUR:
        words.append(f"the blur of {look.blur:g} pixels^2")
    if look.sort != "distance":
        words.append("that they were sorted by depth, not by distance")
    return [f"glTF cannot say {' or '.join(words)}: other programs draw them otherwise"] if words else []

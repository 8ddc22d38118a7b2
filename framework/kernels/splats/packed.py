"""Projection of Gaussians that do not change, packed to be drawn many times.

A block of PACK Gaussians stores each parameter contiguously, so that a kernel loads vectors instead of gathering from
rows. Coefficients of harmonics may take two bytes. A block is skipped if its ball is not on the image.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from nerfloom.kernels import native
from nerfloom.kernels.dispatch import CPP, Operation
from nerfloom.kernels.splats.project import DEGREES, MIN_ALPHA, RECORD, SplatCamera, project_gaussians, sort_keys

PACK = 16
"""Gaussians in a block."""
WIDTHS = (3, 3, 4, 1, 3)
"""Parameters of a Gaussian that are packed as float32: mean, log scales, rotation, logit and colour."""
UNSEEN = -30.0
"""Logit of the Gaussians that fill up the last block."""


class PackedGaussians(NamedTuple):
    """B blocks of PACK Gaussians each."""

    values: Tensor
    """(B, 14, PACK) means, log scales, rotations, logits and colours."""
    harmonics: Tensor
    """(B, 3, K, PACK) coefficients of the harmonics from degree 1, float32 or bfloat16."""
    balls: Tensor
    """(B, 5) centre and radius of a ball that contains a block's means, and the maximum distance from a mean where
    alpha is at least MIN_ALPHA, scene units."""


def pack_gaussians(
    means: Tensor, log_scales: Tensor, rotations: Tensor, logits: Tensor, colors: Tensor, harmonics: Tensor,
    dtype: torch.dtype = torch.float32,
) -> PackedGaussians:  # fmt: skip
    """Pack N Gaussians, at least one, in their order; neighbours in it should be neighbours in space.

    Args:
        means, log_scales, rotations, logits, colors, harmonics: as in `project_gaussians`, but all finite.
        dtype: type of the stored harmonics, float32 or bfloat16.
    """
    count = len(means)
    blocks = -(-count // PACK)

    def filled(rows: Tensor, value: float | None = None) -> Tensor:
        more = rows[-1:] if value is None else torch.full_like(rows[-1:], value)
        return torch.cat([rows, more.expand(blocks * PACK - count, *rows.shape[1:])]).unflatten(0, (blocks, PACK))

    opacities = torch.sigmoid(logits.double())
    reach = (2 * (opacities / MIN_ALPHA).clamp(min=1).log()).sqrt() * log_scales.double().amax(1).exp()
    places = filled(means.double())
    centers = (places.amin(1) + places.amax(1)) / 2
    radii = (places - centers[:, None]).norm(dim=-1).amax(1)
    balls = torch.cat([centers, radii[:, None], filled(reach).amax(1)[:, None]], 1)
    rows = [filled(each) for each in (means, log_scales, rotations)] + [filled(logits[:, None], UNSEEN), filled(colors)]
    return PackedGaussians(
        torch.cat(rows, 2).float().transpose(1, 2).contiguous(),
        filled(harmonics).to(dtype).permute(0, 2, 3, 1).contiguous(),
        torch.cat([balls[:, :3], balls[:, 3:] * (1 + 1e-5)], 1).float(),  # float32 rounds
    )


def project_packed(packed: PackedGaussians, camera: SplatCamera, degree: int = 3) -> Tensor:
    """Project packed Gaussians to an image, without a gradient.

    Args:
        packed: B blocks of Gaussians.
        camera: the camera.
        degree: highest degree of the harmonics that is used, 0 to 3.

    Returns:
        Records (B * PACK, RECORD) as in `project_gaussians`. Gaussians outside the image have a CUT of 0 and undefined
        values in the other columns.
    """
    basis = min(DEGREES[degree], packed.harmonics.shape[2])
    return PROJECT_PACKED((packed.values, packed.balls), packed, camera, basis)


def packed_sort_keys(packed: PackedGaussians, camera: SplatCamera) -> Tensor | None:
    """Return the keys (B * PACK,) of `sort_keys` of `packed` Gaussians for a `camera`."""
    return sort_keys(packed.values[:, : WIDTHS[0]].transpose(1, 2).reshape(-1, WIDTHS[0]), camera)


def project_packed_reference(packed: PackedGaussians, camera: SplatCamera, basis: int) -> Tensor:
    """Compute `project_packed` of `packed` and `camera` in torch; `basis` is as in `project_reference`."""
    rows = packed.values.transpose(1, 2).flatten(0, 1)
    means, log_scales, rotations, logits, colors = rows.split(WIDTHS, 1)
    harmonics = packed.harmonics.permute(0, 3, 1, 2).flatten(0, 1).to(rows)
    degree = {count: degree for degree, count in DEGREES.items()}[basis]
    records, _ = project_gaussians(
        means, log_scales, rotations, logits[:, 0], colors, harmonics, camera=camera, degree=degree
    )
    return records


PROJECT_PACKED = Operation("project_packed", project_packed_reference)
_project = native.Function("splat_project_packed", "ppipqiippi")


@PROJECT_PACKED.implementation(CPP, order=0)
def _compiled(packed: PackedGaussians, camera: SplatCamera, basis: int) -> Tensor:
    blocks, stride = len(packed.values), packed.harmonics.shape[2]
    settings = torch.tensor(camera.plain(), dtype=torch.float64)
    records = packed.values.new_empty(blocks * PACK, RECORD)
    _project(
        native.pointer(packed.values, "the values", (blocks, sum(WIDTHS), PACK)),
        native.pointer(packed.harmonics, "the harmonics", (blocks, 3, stride, PACK), packed.harmonics.dtype),
        packed.harmonics.dtype == torch.bfloat16,
        native.pointer(packed.balls, "the balls", (blocks, 5)), blocks, basis, stride, settings.data_ptr(),
        records.data_ptr(), native.threads(),
    )  # fmt: skip
    return records

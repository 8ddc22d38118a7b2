"""Sorting by ray of the samples that light reached."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from nerfloom.kernels import native
from nerfloom.kernels.argument_checks import check_indices
from nerfloom.kernels.dispatch import CPP, INT64, TRITON, Operation
from nerfloom.kernels.triton_backend import later


def sort_by_ray(owners: Tensor, reached: Tensor, num_rays: int) -> tuple[Tensor, Tensor]:
    """Return the order (M,) that sorts the reached samples by ray, stably, and the offsets (R + 1,) of the rays.

    Args:
        owners: (N,) int64 index of the ray of each sample.
        reached: (N,) uint8, nonzero for samples to keep.
        num_rays: number R of rays.

    Raises:
        IndexError: if an index of a ray is out of range.
    """
    return SORT_BY_RAY((owners,), owners, reached, num_rays)


def sort_by_ray_reference(owners: Tensor, reached: Tensor, num_rays: int) -> tuple[Tensor, Tensor]:
    """Compute `sort_by_ray` of `owners`, `reached` and `num_rays` in PyTorch, on any device."""
    check_indices(owners, num_rays, "rays")
    chosen = reached.nonzero().squeeze(-1)
    owners = owners.index_select(0, chosen)
    counts = owners.new_zeros(num_rays).index_add_(0, owners, torch.ones_like(owners))
    return chosen.index_select(0, owners.argsort(stable=True)), functional.pad(counts.cumsum(0), (1, 0))


SORT_BY_RAY = Operation("sort_by_ray", sort_by_ray_reference)


@SORT_BY_RAY.implementation(CPP, types=INT64)
def _sort_by_ray(owners: Tensor, reached: Tensor, num_rays: int) -> tuple[Tensor, Tensor]:
    order, offsets = torch.empty_like(owners), torch.empty(num_rays + 1, dtype=torch.int64)
    count = len(owners)
    kept = _sort(
        native.pointer(owners, "owners", (count,), torch.int64),
        native.pointer(reached, "reached", (count,), torch.uint8), count, num_rays, order.data_ptr(),
        offsets.data_ptr(),
    )  # fmt: skip
    return order[:kept], offsets


SORT_BY_RAY.implementation(TRITON, types=INT64)(later("march.waves_triton", "sort_by_ray"))
_sort: Callable[..., int] = native.Function("sort_by_ray", "ppqqpp", "q")

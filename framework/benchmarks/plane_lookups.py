"""Looking features up in planes and lines, compiled, against torch's `grid_sample`."""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from framework.kernels.planes import PlanesLayout, planes, planes_reference

STEPS = ("compiled forward", "compiled backward", "grid_sample forward", "grid_sample backward")


def layouts() -> list[tuple[str, PlanesLayout, int]]:
    """Names, layouts and features of K-Planes, still and moving, and of TensoRF."""
    scales = tuple((64 << s,) * 3 for s in range(4))
    moving = tuple((64 << s,) * 3 + (25,) for s in range(4))
    across = (((0, 1), (2,)), ((0, 2), (1,)), ((1, 2), (0,)))
    return [
        ("K-Planes, 4 scales to 512, 3 planes of 32", PlanesLayout.build(scales), 32),
        ("K-Planes, 4 scales to 512, 6 planes of 32", PlanesLayout.build(moving), 32),
        ("TensoRF VM, 300^3, 48", PlanesLayout.build(((300,) * 3,) * 3, across), 48),
    ]


def plane_lookup(
    name: str, layout: PlanesLayout, features: int, count: int, repeats: int, all_threads: int
) -> dict[str, object]:
    """Times of both, in turn, on 1 thread and on all, and their errors against float64."""
    torch.manual_seed(0)
    positions = torch.rand(count, layout.dims)
    table = torch.rand(layout.num_entries, features) + 0.5
    weight = torch.randn(count, layout.num_groups * features)
    out: dict[str, object] = {"kernel": name, "samples": count}
    for threads in sorted({1, all_threads}):
        torch.set_num_threads(threads)
        spent = [_once(positions, table, layout, weight) for _ in range(repeats + 1)][1:]  # the first is a warm-up
        times = dict(zip(STEPS, zip(*spent, strict=True), strict=True))
        for step, found in times.items():
            out[f"{step}, ns per sample, {threads} threads"] = round(median(found) / count * 1e9, 1)
        for way in ("forward", "backward"):
            ratios = [b / a for a, b in zip(times[f"compiled {way}"], times[f"grid_sample {way}"], strict=True)]
            out[f"speed-up {way}, {threads} threads"] = round(median(ratios), 1)
    return out | _errors(positions, table, layout, weight)


def _once(positions: Tensor, table: Tensor, layout: PlanesLayout, weight: Tensor) -> tuple[float, ...]:
    """Seconds of each of `STEPS`."""
    leaf, stored = table.clone().requires_grad_(), _as_images(table, layout)
    spent: list[float] = []
    for look_up in (lambda: planes(positions, leaf, layout), lambda: _sampled(positions, stored, layout)):
        spent += _timed(look_up, weight)
    return tuple(spent)


def _timed(look_up: Callable[[], Tensor], weight: Tensor) -> tuple[float, float]:
    start = time.perf_counter()
    value = look_up()
    middle = time.perf_counter()
    value.backward(weight)
    return middle - start, time.perf_counter() - middle


def _as_images(table: Tensor, layout: PlanesLayout) -> list[list[Tensor]]:
    """Every factor as an image (1, F, H, W) of its own, as K-Planes' code has them."""
    return [
        [
            layout.factor(table, group, index).permute(2, 0, 1)[None].contiguous().requires_grad_()
            for index in range(len(factors))
        ]
        for group, factors in enumerate(layout.axes)
    ]


def _sampled(positions: Tensor, stored: list[list[Tensor]], layout: PlanesLayout) -> Tensor:
    """Features (N, G * F) by `grid_sample`."""
    groups = []
    for factors, images in zip(layout.axes, stored, strict=True):
        product: Tensor | None = None
        for axes, image in zip(factors, images, strict=True):
            where = positions[:, list(axes)]
            if len(axes) == 1:
                where = torch.cat([where, torch.zeros(len(positions), 1)], dim=1)
            found = grid_sample(image, where[None, None] * 2 - 1, align_corners=True, padding_mode="border")[
                0, :, 0
            ].t()
            product = found if product is None else product * found
        assert product is not None
        groups.append(product)
    return torch.cat(groups, dim=-1)


def _errors(positions: Tensor, table: Tensor, layout: PlanesLayout, weight: Tensor) -> dict[str, float]:
    """Largest errors over the largest value, of both, of values and of the table's gradients."""
    leaf, stored, truth = table.clone().requires_grad_(), _as_images(table, layout), table.double().requires_grad_()
    value, other = planes(positions, leaf, layout), _sampled(positions, stored, layout)
    exact = planes_reference(positions.double(), truth, layout)
    for found in (value, other):
        found.backward(weight)
    exact.backward(weight.double())
    assert leaf.grad is not None
    assert truth.grad is not None
    grads = [image.grad for group in stored for image in group if image.grad is not None]
    theirs = torch.cat([grad[0].permute(1, 2, 0).reshape(-1, table.shape[1]) for grad in grads])
    return {
        key: float((result.detach().double() - right.detach()).abs().max() / right.detach().abs().max())
        for key, result, right in (
            ("error of the value", value, exact),
            ("grid_sample's error of the value", other, exact),
            ("error of the gradient", leaf.grad, truth.grad),
            ("grid_sample's error of the gradient", theirs, truth.grad),
        )
    }

"""The kernels of Gaussian splatting and their references, in the form for `ns-bench kernels`.

A pair is a Gaussian and a pixel it is blended into. Evaluations that turn out to be below the cutoff count for the time
per pair, not for the number of pairs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from nerfloom.benchmarks.ceilings import Work
from nerfloom.benchmarks.compared import Errors, Kernel, errors, of_function
from nerfloom.benchmarks.timing import differentiated, once
from nerfloom.kernels.splats.blend import Blended, blend, blend_reference, blended_pairs
from nerfloom.kernels.splats.project import Record, SplatCamera, project_gaussians, project_reference
from nerfloom.kernels.splats.tiles import TileLists, tile_lists, tile_lists_reference

COUNT, WIDTH, HEIGHT = 20_000, 300, 300
"""Gaussians, and the image's size in pixels."""
BOUND = 20.0
"""Added to the exponent of the cutoff for error measurements, where it must not matter whether a pixel is within."""


def splatting() -> Iterator[Kernel]:
    """Yield projection, tile lists, and blending, of 20 000 Gaussians on a 300 x 300 image."""
    camera = SplatCamera(torch.eye(3, 4), (300.0, 300.0, WIDTH / 2, HEIGHT / 2), WIDTH, HEIGHT)
    centers, sizes = torch.randn(COUNT, 3) * 0.5 + torch.tensor([0.0, 0.0, 3.0]), torch.randn(COUNT, 3) * 0.5 - 4
    shades = torch.randn(COUNT, 3), torch.randn(COUNT, 3, 15) * 0.1
    parameters = [centers, sizes, torch.randn(COUNT, 4), torch.randn(COUNT), *shades]

    def ours(means: Tensor, scales: Tensor, turns: Tensor, logits: Tensor, colors: Tensor, harmonics: Tensor) -> Tensor:
        return project_gaussians(means, scales, turns, logits, colors, harmonics, camera)[0]

    def exact(
        means: Tensor, scales: Tensor, turns: Tensor, logits: Tensor, colors: Tensor, harmonics: Tensor
    ) -> Tensor:
        return project_reference(means, scales, turns, logits, colors, harmonics, camera, 15)[0]

    records = ours(*parameters)
    work = Work(bytes=4 * (14 + 45 + 16))
    yield of_function("projection of Gaussians, degree 3", parameters, ours, exact, work, unit="Gaussian")
    yield _listing(records)
    yield _blending(records)


def _listing(records: Tensor) -> Kernel:
    runs = (
        once(lambda: tile_lists(records, WIDTH, HEIGHT)),
        once(lambda: tile_lists_reference(records, WIDTH, HEIGHT)),
    )
    return Kernel("sorting Gaussians into tiles' lists", "Gaussian", COUNT, runs, None)


def _blending(records: Tensor) -> Kernel:
    lists = tile_lists(records, WIDTH, HEIGHT)
    background = torch.rand(3)

    def image(form: Callable[..., Blended], listed: TileLists) -> Callable[[Tensor], Tensor]:
        return lambda values: form(values, listed, WIDTH, HEIGHT, background, 3, False).image

    def found() -> tuple[Errors, Errors]:
        wide = _wide(records)
        listed = tile_lists(wide, WIDTH, HEIGHT)
        kept = torch.ones(wide.shape[1])
        kept[[Record.CUT, Record.REACH_X, Record.REACH_Y]] = 0  # the gradient has sums of absolute gradients there

        def colored(form: Callable[..., Blended]) -> Callable[[Tensor], Tensor]:
            run = image(form, listed)
            return lambda values: run(torch.where(kept > 0, values, values.detach()))

        ours, exact = colored(blend), colored(blend_reference)
        return errors(ours, exact, [wide], True), errors(exact, exact, [wide], True)

    ours, theirs = (differentiated(image(form, lists), [records], None) for form in (blend, blend_reference))
    return Kernel(
        f"blending of Gaussians, {WIDTH} x {HEIGHT}",
        "pair",
        blended_pairs(records, lists, WIDTH, HEIGHT),
        (ours, theirs),
        None,
        found,
    )


def _wide(records: Tensor) -> Tensor:
    """Return records with a cutoff so far out that alpha is nothing there."""
    wide, visible = records.clone(), records[:, Record.CUT] > 0
    stretch = (1 + BOUND / records[:, Record.CUT]).sqrt()
    wide[:, Record.CUT] = torch.where(visible, records[:, Record.CUT] + BOUND, 0)
    for column in (Record.REACH_X, Record.REACH_Y):
        wide[:, column] = torch.where(visible, records[:, column] * stretch, 0)
    return wide

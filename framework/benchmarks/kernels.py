"""Time and error of each compiled kernel and its torch reference, with the machine's limits.

Both run in one process, in turn, on one thread and on all. Errors of both are against float64. NERFLOOM_KERNELS=avx2 in
the environment selects that variant.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

import torch
from rich.box import SIMPLE
from rich.table import Table
from torch import Tensor
from torch.nn.functional import normalize

from nerfloom.base.console import console, say
from nerfloom.base.errors import ConfigError
from nerfloom.benchmarks.ceilings import Ceilings, Work
from nerfloom.benchmarks.compared import Errors, Kernel, errors, of_function
from nerfloom.benchmarks.plane_lookups import grid_samples, layouts, planes_of
from nerfloom.benchmarks.splatting import splatting
from nerfloom.benchmarks.timing import Run, alternating, differentiated, once
from nerfloom.cameras.cameras import Cameras
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels import native
from nerfloom.kernels.adam.adam import sparse_adam, sparse_adam_reference
from nerfloom.kernels.compositing.density import composite, composite_reference
from nerfloom.kernels.encodings.frequency import frequency_encoding, frequency_encoding_reference
from nerfloom.kernels.encodings.integrated_directional import directional_encoding, directional_encoding_reference
from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics, spherical_harmonics_reference
from nerfloom.kernels.grids.hash_grid import hash_grid, hash_grid_reference
from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout
from nerfloom.kernels.grids.multisampled_grid import multisampled_grid, multisampled_grid_reference
from nerfloom.kernels.grids.planes import planes, planes_reference
from nerfloom.kernels.grids.planes_layout import PlanesLayout
from nerfloom.kernels.histograms.step_functions import blurred_excess, blurred_excess_reference
from nerfloom.kernels.images.ssim import photometric_loss, photometric_reference
from nerfloom.kernels.march.occupancy import Occupancy
from nerfloom.kernels.march.waves import March, ReferenceMarch, march
from nerfloom.kernels.networks.mlp import Activation, mlp, mlp_reference
from nerfloom.training.machine import machine

UNITS = "sample, ray, entry, pixel, Gaussian or pair"
"""Units of the kernels' work."""
LENSES: tuple[tuple[str, list[float]], ...] = (
    ("pinhole", []),
    ("opencv", [-0.28, 0.09, 6e-4, -9e-4, 0, 0, 0, 0, 0]),
    ("fisheye", [0.04, -0.01, 3e-3, -6e-4]),
)
"""Lens models, with typical coefficients."""


@dataclass(frozen=True)
class Row:
    """Measurements of `kernel` with `count` units per run on `threads` threads; times are ns per `unit`.

    Times are `forward` and `backward`, and the reference's `reference_forward` and `reference_backward`; `errors` and
    `reference_errors` are the errors of each.
    """

    kernel: str
    unit: str
    count: int
    threads: int
    forward: float
    backward: float | None
    reference_forward: float
    reference_backward: float | None
    speed_up: float
    """Median ratio of the times of neighbouring runs, forward and backward together."""
    at_ceiling: float | None
    """Time of the forward pass at the machine's limit, on all threads."""
    errors: Errors | None
    reference_errors: Errors | None


def measure(samples: int, repeats: int) -> tuple[list[Row], dict[str, Any]]:
    """Measure every kernel in `repeats` runs with batches of `samples`, and print a table of medians.

    Returns:
        The rows, and rows, machine and limits as plain data.

    Raises:
        ConfigError: if there are no compiled kernels.
    """
    if not native.available():
        raise ConfigError("there are no compiled kernels to measure; install a C++ compiler and reinstall nerfloom")
    threads, ceilings, rows = torch.get_num_threads(), Ceilings.measured(), []
    for line in ceilings.lines():
        say(f"ceiling: {line}")
    for kernel in kernels(samples):
        say(f"measuring {kernel.name}")
        rows += measured(kernel, ceilings, repeats, threads)
    console.print(table([row for row in rows if row.threads == threads]))
    return rows, {"machine": machine(), "ceilings": asdict(ceilings), "rows": [asdict(row) for row in rows]}


def measured(kernel: Kernel, ceilings: Ceilings, repeats: int, all_threads: int) -> list[Row]:
    """Measure a `kernel` in `repeats` runs, on 1 thread and on `all_threads`, with `ceilings` of the machine."""
    rows = []
    errors, reference_errors = kernel.errors() if kernel.errors else (None, None)
    at_ceiling = ceilings.seconds(kernel.work) * 1e9 if kernel.work else None
    try:
        for threads in sorted({1, all_threads}):
            torch.set_num_threads(threads)
            times = alternating(*kernel.runs, repeats)
            (forward, *backward), (reference_forward, *reference_backward) = (
                [seconds / kernel.count * 1e9 for seconds in stages] for stages in (times.compiled, times.reference)
            )
            rows.append(
                Row(
                    kernel.name,
                    kernel.unit,
                    kernel.count,
                    threads,
                    forward,
                    backward[0] if backward else None,
                    reference_forward,
                    reference_backward[0] if reference_backward else None,
                    times.speed_up,
                    at_ceiling,
                    errors,
                    reference_errors,
                )
            )
    finally:
        torch.set_num_threads(all_threads)
    return rows


def table(rows: Sequence[Row]) -> Table:
    """Return a table of `rows`, with the width of a terminal."""
    grid = Table(title=f"ns a {UNITS}", title_justify="left", box=SIMPLE, padding=(0, 1, 0, 0))
    for heading in ("kernel", "forward", "backward", "torch", "speed-up", "error"):
        grid.add_column(heading, justify="left" if heading == "kernel" else "right", no_wrap=heading != "kernel")
    for row in rows:
        grid.add_row(
            row.kernel,
            f"{row.forward:.1f}",
            "" if row.backward is None else f"{row.backward:.1f}",
            f"{row.reference_forward + (row.reference_backward or 0):.0f}",
            f"{row.speed_up:.1f}",
            "" if row.errors is None else f"{row.errors.value:.0e}",
        )
    return grid


# -- the kernels --------------------------------------------------------------------------------------------------


def kernels(count: int) -> Iterator[Kernel]:
    """Yield all kernels, with batches of `count` samples."""
    yield from on_any_device(count)
    networks: list[tuple[tuple[int, ...], Activation]] = [((32, 64, 16), "none"), ((32, 64, 64, 3), "sigmoid")]
    for widths, activation in networks:
        for kind in ("float32", "bfloat16") if native.has("mlp_forward_bf16") else ("float32",):
            name = f"network {'-'.join(map(str, widths))}, {kind}"
            yield of_function(name, *_network(count, widths, activation, kind == "bfloat16"))
    yield of_function("multisampled grid, 8 levels x 4, tables of 2^18", *_multisampled(count))
    yield _blurring(count // 16)
    for model, lens in LENSES:
        yield _ray_generation(model, lens)


def on_any_device(count: int) -> Iterator[Kernel]:
    """Yield the kernels for both CPUs and GPUs, on torch's default device, with batches of `count` samples."""
    torch.manual_seed(0)
    positions = rays_and_positions(count)[1]
    for log2 in (15, 17, 19):
        yield of_function(f"hash grid, 16 levels x 2, tables of 2^{log2}", *_hash_grid(positions, log2, False))
    yield of_function("hash grid, gradient of positions too, 2^17", *_hash_grid(positions, 17, True))
    yield of_function("compositing, 16 samples a ray", *_compositing(count))
    yield of_function(
        "frequency encoding, 10 octaves of 3",
        [torch.rand(count, 3)],
        lambda x: frequency_encoding(x, 10),
        lambda x: frequency_encoding_reference(x, 10),
        Work(bytes=4 * (3 + 60)),
    )
    yield of_function(
        "spherical harmonics, 4 bands",
        [normalize(torch.randn(count, 3), dim=-1)],
        spherical_harmonics,
        spherical_harmonics_reference,
        Work(bytes=4 * (3 + 16)),
        backward=False,
    )
    yield of_function(
        "directional encoding, 5 bands",
        [normalize(torch.randn(count, 3), dim=-1), torch.rand(count)],
        directional_encoding,
        directional_encoding_reference,
        Work(bytes=4 * (4 + 67)),
    )
    for name, layout, features in layouts():
        yield _plane_lookup(name, layout, features, count)
    yield _marching()
    yield _updating()
    yield _similarity()
    yield from splatting()


def rays_and_positions(count: int) -> tuple[Rays, Tensor]:
    """Return rays through the unit box, and `count` positions, with 16 close together per ray as in a trained scene."""
    origins = normalize(torch.randn(count // 16, 3), dim=-1) * 2 + 0.5
    directions = normalize(torch.rand(count // 16, 3) - origins, dim=-1)
    rays = Rays(origins, directions, torch.zeros(count // 16), torch.full((count // 16,), 9.0))
    t = (2 + torch.rand(count // 16, 1) - 0.5) + torch.arange(16) * 0.003
    positions = origins[:, None] + t[..., None] * directions[:, None]
    return rays, positions.reshape(-1, 3).clamp(0, 1)


Described = tuple[list[Tensor], Callable[..., Tensor], Callable[..., Tensor], Work]
"""Inputs, compiled function, reference, and work."""


def _hash_grid(positions: Tensor, log2: int, of_positions: bool) -> Described:
    layout = HashGridLayout.build(16, 16, 1024, log2)
    values = torch.randn(layout.num_entries, 2)
    # As in most fields, there are no gradients of positions, so they are detached.
    attached = (lambda x: x) if of_positions else torch.Tensor.detach
    return (
        [positions, values],
        lambda x, t: hash_grid(attached(x), t, layout),
        lambda x, t: hash_grid_reference(attached(x), t, layout),
        Work(bytes=4 * (3 + 32), gathers=16 * 8, table_bytes=values.nbytes),
    )


def _multisampled(count: int) -> Described:
    """Look up 6 points around each position, spaced as in frustums, with half of the spacing as deviations."""
    layout, spread = HashGridLayout.build(8, 16, 2048, 18), 0.003
    values = torch.randn(layout.num_entries, 4)
    around = rays_and_positions(count)[1][:, None] + spread * torch.randn(count, 6, 3)
    points = torch.cat([around.clamp(0, 1), torch.full((count, 6, 1), spread / 2)], dim=-1)
    return (
        [points, values],
        lambda x, t: multisampled_grid(x.detach(), t, layout),
        lambda x, t: multisampled_grid_reference(x.detach(), t, layout),
        Work(bytes=4 * (24 + 32), gathers=6 * 8 * 8 * 2, table_bytes=values.nbytes),
    )


def _blurring(rays: int) -> Kernel:
    """Compute Zip-NeRF's loss of 64 proposed intervals per ray against 32 blurred ones."""
    edges, proposed = (torch.rand(rays, bins + 1).sort(dim=-1).values for bins in (32, 64))
    weights, given = (normalize(torch.rand(rays, bins), p=1, dim=-1) for bins in (32, 64))

    def ours(p: Tensor) -> Tensor:
        return blurred_excess(edges, weights, proposed, p, 0.01)

    def exact(p: Tensor) -> Tensor:
        return blurred_excess_reference(edges.to(p), weights.to(p), proposed.to(p), p, 0.01)

    work = Work(bytes=4 * (33 + 32 + 65 + 64 + 64 + 1))  # both histograms read, the loss and its derivative written
    return of_function("loss of proposals, blurred, 32 against 64", [given], ours, exact, work, unit="ray")


def _network(count: int, widths: tuple[int, ...], activation: Activation, bfloat16: bool) -> Described:
    weights = [torch.randn(b, a) * (2 / a) ** 0.5 for a, b in pairwise(widths)]

    def compiled(x: Tensor, *w: Tensor) -> Tensor:
        with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
            return mlp([x], w, activation)

    return (
        [torch.randn(count, widths[0]), *weights],
        compiled,
        lambda x, *w: mlp_reference([x], w, activation),
        Work(4 * (widths[0] + widths[-1]), flops=2 * sum(a * b for a, b in pairwise(widths)), bfloat16=bfloat16),
    )


def _compositing(count: int) -> Described:
    offsets = torch.arange(0, count + 1, 16)
    starts = (torch.rand(count // 16, 1) + torch.arange(16) * 0.01).reshape(-1)
    samples = Samples(starts, starts + 0.01, offsets)
    background, fars = torch.rand(count // 16, 3), torch.full((count // 16,), 9.0)

    def reference(density: Tensor, color: Tensor) -> Tensor:
        like = Samples(samples.t_starts.to(density), samples.t_ends.to(density), offsets)
        return composite_reference(like, density, color, background.to(density), fars.to(density)).color

    return (
        [torch.rand(count) * 50, torch.rand(count, 3)],
        lambda density, color: composite(samples, density, color, background, fars).color,
        reference,
        Work(bytes=4 * (2 + 1 + 3) + 4 * 3 / 16),
    )


def _plane_lookup(name: str, layout: PlanesLayout, features: int, count: int) -> Kernel:
    """Compare with torch's `grid_sample`; the limit is copying, because the features of a corner are adjacent."""
    positions = torch.rand(count, layout.dims)
    values = torch.rand(layout.num_entries, features) + 0.5
    gradient = torch.randn(count, layout.num_groups * features)
    images = planes_of(values, layout)
    corners = sum(2 ** len(axes) for factors in layout.axes for axes in factors)

    def ours(v: Tensor) -> Tensor:
        return planes(positions, v, layout)

    def exact(v: Tensor) -> Tensor:
        return planes_reference(positions.to(v), v, layout)

    def theirs(*flat: Tensor) -> Tensor:
        return grid_samples(positions, list(flat), layout)

    return Kernel(
        name,
        "sample",
        count,
        (differentiated(ours, [values], gradient), differentiated(theirs, images, gradient)),
        Work(bytes=4 * features * (corners + layout.num_groups)),
        lambda: (errors(ours, exact, [values], True), errors(exact, exact, [values], True)),
    )


def _marching() -> Kernel:
    """Find all samples of 8192 rays through a grid with 3 % of its cells occupied."""
    rays, _ = rays_and_positions(8192 * 16)
    centers = (torch.cartesian_prod(*[torch.arange(128)] * 3) + 0.5) / 128 - 0.5
    box = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    grid = Occupancy((centers.norm(dim=-1) - 0.3).abs() < 0.015, box, 128)

    def through(start: Callable[..., March]) -> None:
        marching = start(rays, grid, 3**0.5 / 512, 0.0, None, 1e-4)
        while (wave := marching.wave(16)) is not None:
            marching.advance(torch.zeros_like(wave.t_starts))

    runs = once(lambda: through(march)), once(lambda: through(ReferenceMarch))
    return Kernel("marching through a grid of 128^3, 3 % occupied", "ray", len(rays), runs, None)


def _updating() -> Kernel:
    """Update a table by sparse Adam, with a gradient for half of the entries."""
    entries = 2**19
    grad = torch.randn(entries, 2) * (torch.rand(entries, 1) < 0.5)
    updated = int((grad != 0).any(dim=1).sum())

    def steps(update: Callable[..., object]) -> Run:
        values, mean, square, uses = torch.randn(entries, 2), *torch.zeros(2, entries, 2), torch.zeros(entries)

        def step() -> Sequence[float]:
            fresh = grad.clone()
            return once(lambda: update(values, fresh, mean, square, uses, 1e-2, (0.9, 0.95), 1e-15))()

        return step

    work = Work(bytes=4 * (2 * 4 + 1) * 2)  # 2 values, gradients, moments of both kinds, and counts: read and written
    runs = steps(sparse_adam), steps(sparse_adam_reference)
    return Kernel("sparse Adam, half of 2^19 x 2", "entry", updated, runs, work)


def _similarity() -> Kernel:
    """Compute the loss of a 400 x 400 image, absolute error and SSIM; the forward pass includes the derivative."""
    target = torch.nn.functional.avg_pool2d(torch.rand(3, 406, 406), 7, 1).permute(1, 2, 0).contiguous()
    image = (target + 0.05 * torch.randn_like(target)).clamp(0, 1)

    def against(form: Callable[[Tensor, Tensor, float], Tensor]) -> Callable[[Tensor], Tensor]:
        return lambda x: form(x, target.to(x), 0.2)

    ours, exact = against(photometric_loss), against(photometric_reference)
    work = Work(bytes=4 * 3 * 3)  # both images read, a gradient written
    return of_function("loss with SSIM, 400 x 400 x 3", [image], ours, exact, work, unit="pixel", count=400 * 400)


def _ray_generation(model: str, lens: list[float]) -> Kernel:
    """Compute rays through 8192 pixels of images of 1600 x 1200 with a typical lens."""
    focal, cx, cy, width, height = (torch.tensor([value]) for value in (1100.0, 800.0, 600.0, 1600, 1200))
    coefficients = torch.tensor([lens]) if lens else None
    cameras = Cameras(torch.eye(4)[None, :3], focal, focal, cx, cy, width, height, model, coefficients)
    flat = torch.randint(1600 * 1200, (8192,))
    runs = once(lambda: cameras.pixel_rays(flat, 0.1, 9.0)), once(lambda: cameras.pixel_rays_reference(flat, 0.1, 9.0))
    return Kernel(f"rays of {model} cameras", "ray", len(flat), runs, Work(bytes=8 + 4 * (3 + 3 + 2)))

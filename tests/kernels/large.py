"""Operations that share work out over threads, on enough of it: errors beside the references, and a hash of all bits.

    python -m tests.kernels.large [THREADS]

prints a line of JSON, without the errors: where the bits are the same, so are they. Without THREADS as many are used as
torch finds in its environment.
"""

import hashlib
import json
import math
import sys
from collections.abc import Callable

import torch
from torch import Tensor

from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.adam.adam import dense_adam, dense_adam_reference, sparse_adam, sparse_adam_reference
from nerfloom.kernels.compositing.density import composite, composite_reference, distortion
from nerfloom.kernels.encodings.contraction import contract_to_unit, contract_to_unit_reference
from nerfloom.kernels.encodings.frequency import frequency_encoding, frequency_encoding_reference
from nerfloom.kernels.grids.hash_grid import hash_grid, hash_grid_reference
from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout
from nerfloom.kernels.grids.planes import planes, planes_reference
from nerfloom.kernels.grids.planes_layout import PlanesLayout
from nerfloom.kernels.histograms.intervals import (
    interval_weights,
    interval_weights_reference,
    resample,
    resample_reference,
)
from nerfloom.kernels.images.ssim import similarity_reference, ssim
from nerfloom.kernels.march.occupancy import Occupancy, refresh_occupancy
from nerfloom.kernels.march.waves import CompiledMarch, ReferenceMarch
from nerfloom.kernels.native import torch_on_one_thread
from nerfloom.kernels.networks.mlp import mlp, mlp_reference
from nerfloom.kernels.splats.blend import blend, blend_reference
from nerfloom.kernels.splats.project import RECORD, Record, SplatCamera, project_gaussians, project_reference
from nerfloom.kernels.splats.tiles import tile_lists, tile_lists_reference
from nerfloom.samplers.occupancy import OccupancySampler
from tests.kernels import test_trace
from tests.kernels.compiled import relative_error

COUNT = 20_000
GRID = HashGridLayout.build(8, 8, 128, 14)
PLANES = PlanesLayout.build(((32, 32, 32), (64, 64, 64)))
BOX = torch.tensor([[-1.0] * 3, [1.0] * 3])


def with_gradients(call: Callable[..., Tensor], inputs: list[Tensor], direction: Tensor, dtype: torch.dtype) -> list:
    """The value, and the gradients of all inputs along `direction`."""
    leaves = [x.to(dtype).requires_grad_() for x in inputs]
    value = call(*leaves)
    return [value.detach(), *torch.autograd.grad(value, leaves, direction.to(value))]


def gaussians(count: int) -> list[Tensor]:
    """Parameters of Gaussians in front of a camera, and its pose."""
    means = torch.randn(count, 3) + torch.tensor([0.0, 0.0, 5.0])
    harmonics = torch.randn(count, 3, 15) / 5
    rows = [means.clamp(min=-4), torch.randn(count, 3) / 2 - 3, torch.randn(count, 4), torch.rand(count)]
    return [*rows, torch.randn(count, 3), harmonics, torch.eye(3, 4)]


def seen_by(pose: Tensor) -> SplatCamera:
    return SplatCamera(pose, (150.0, 160.0, 75.0, 70.0), 150, 140, antialiased=True)


def wide_records(count: int) -> Tensor:
    """Records so wide that alpha at their bounds is nothing: whether a pixel is within does not matter."""
    records = torch.zeros(count, RECORD)
    records[:, :2], records[:, Record.U_X : Record.OPACITY] = 150 * torch.rand(count, 2), 0.5 + torch.rand(count, 3) / 5
    records[:, Record.OPACITY], records[:, Record.CUT] = torch.rand(count) / 2, 60.0
    records[:, [Record.REACH_X, Record.REACH_Y]] = 25.0
    records[:, Record.RED : Record.NORMAL_X] = torch.rand(count, 4)
    return records


def on_image(form: Callable[..., object]) -> Callable[..., Tensor]:
    """Image, distance and transmittance of records (N, RECORD)."""

    def run(records: Tensor) -> Tensor:
        # The bounds of a Gaussian have no gradient; the compiled form uses their place for other values.
        shape, bounds, rest = records.split([Record.CUT, Record.RED - Record.CUT, RECORD - Record.RED], -1)
        records = torch.cat([shape, bounds.detach(), rest], -1)
        found = form(records, tile_lists(records.float(), 150, 140), 150, 140, torch.ones(3), 4, False)
        return torch.cat([found.image, found.transmittance[..., None]], -1).flatten(0, 1)  # type: ignore[attr-defined]

    return run


def differentiable() -> dict[str, tuple[Callable[..., Tensor], Callable[..., Tensor], list[Tensor], int]]:
    """Compiled form, reference, inputs, and features of the result."""
    positions = torch.rand(COUNT, 3)
    layers = [torch.randn(64, 32) / 6, torch.randn(64, 64) / 8, torch.randn(16, 64) / 8]
    offsets = torch.arange(0, COUNT + 1, 8)
    starts = torch.linspace(0, 1, 8).repeat(COUNT // 8)
    samples = Samples(starts, starts + 0.1, offsets)
    in_64 = Samples(starts.double(), starts.double() + 0.1, offsets)
    rays = COUNT // 8

    def colors(form: Callable[..., object], over: Samples) -> Callable[..., Tensor]:
        def run(sigma: Tensor, rgb: Tensor) -> Tensor:
            background, fars = torch.full((3,), 0.5).to(sigma), torch.full((rays,), 2.0).to(sigma)
            return form(over, sigma, rgb, background, fars).color  # type: ignore[attr-defined]

        return run

    edges = torch.linspace(0, 3, 33).expand(COUNT // 10, 33)
    target = torch.rand(150, 140, 3)
    return {
        "hash grid": (
            lambda x, table: hash_grid(x, table, GRID),
            lambda x, table: hash_grid_reference(x, table, GRID),
            [positions, torch.randn(GRID.num_entries, 2)],
            16,
        ),
        "planes": (
            lambda x, table: planes(x, table, PLANES),
            lambda x, table: planes_reference(x, table, PLANES),
            [positions, torch.rand(PLANES.num_entries, 16)],
            32,
        ),
        "network": (
            lambda x, *weights: mlp([x], weights),
            lambda x, *weights: mlp_reference([x], weights),
            [torch.randn(COUNT, 32), *layers],
            16,
        ),
        "compositing": (
            colors(composite, samples),
            colors(composite_reference, in_64),
            [3 * torch.rand(COUNT), torch.rand(COUNT, 3)],
            3,
        ),
        "distortion": (
            lambda w: distortion(w, samples)[:, None],
            lambda w: distortion(w, in_64)[:, None],
            [torch.rand(COUNT) / 8],
            1,
        ),
        "contraction": (
            lambda x: contract_to_unit(x, BOX),
            lambda x: contract_to_unit_reference(x, BOX.double()),
            [4 * torch.randn(COUNT, 3)],
            3,
        ),
        "frequencies": (
            lambda x: frequency_encoding(x, 6),
            lambda x: frequency_encoding_reference(x, 6),
            [torch.rand(COUNT, 3)],
            39,
        ),
        "interval weights": (
            lambda sigma: interval_weights(sigma, edges.contiguous()),
            lambda sigma: interval_weights_reference(sigma, edges.double()),
            [torch.rand(COUNT // 10, 32)],
            32,
        ),
        "projected Gaussians": (
            lambda *given: project_gaussians(*given[:-1], seen_by(given[-1]))[0],
            lambda *given: project_reference(*given[:-1], seen_by(given[-1]), 15)[0],
            gaussians(COUNT // 4),
            RECORD,
        ),
        "blended Gaussians": (on_image(blend), on_image(blend_reference), [wide_records(2000)], 5),
        "similarity": (
            lambda x: ssim(x, target)[None, None],
            lambda x: similarity_reference(x, target.double(), None, True)[None, None],
            [torch.rand(150, 140, 3)],
            1,
        ),
    }


def optimised(form: Callable[..., object], dtype: torch.dtype, **extra: Tensor) -> list[Tensor]:
    """Parameters and moments after three steps of Adam, dense or sparse."""
    torch.manual_seed(1)
    values, mean, square = (torch.rand(COUNT, 2).to(dtype) for _ in range(3))
    seen, step = torch.zeros(COUNT, dtype=dtype), torch.zeros(())
    for _ in range(3):
        grad = torch.randn(COUNT, 2).to(dtype) * (torch.rand(COUNT, 1) > 0.5)
        if form in (dense_adam, dense_adam_reference):
            form([values], [grad], [mean], [square], [step], 0.01, (0.9, 0.99), 1e-15)
        else:
            form(values, grad, mean, square, seen, 0.01, (0.9, 0.99), 1e-15)
    return [values, mean, square]


def marched(kind: type) -> list[Tensor]:
    """The samples of rays through a grid of random cells, until their light is spent."""
    torch.manual_seed(2)
    count = 3000
    origins = 3 * torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)
    directions = torch.nn.functional.normalize(torch.rand(count, 3) - 0.5 - origins, dim=-1)
    rays = Rays(origins, directions, torch.zeros(count), torch.full((count,), 10.0))
    march = kind(rays, Occupancy(torch.rand(32**3) < 0.1, BOX, 32), 0.01, 0.0, None, 1e-3)
    sizes = [8, 8, 16, 1000]
    while (wave := march.wave(sizes.pop(0) if sizes else 1000)) is not None:
        march.advance(torch.full((len(wave.owners),), 20.0))
    order, offsets = march.finish()
    return [
        order,
        offsets,
        *(torch.cat([getattr(w, name) for w in march.waves])[order] for name in ("t_starts", "owners")),
    ]


def traced(wave_by_wave: bool = False) -> list[Tensor]:
    """Samples of rays through a hash grid with a network, in one call or wave by wave, and the gradients of both."""
    sampler, field = OccupancySampler(test_trace.BOX, 32, 200, 1e-2), test_trace.fields(True, 2)[wave_by_wave]
    torch.manual_seed(3)
    sampler.occupied = torch.rand(32**3) < 0.3
    samples = sampler.sample(test_trace.rays(3000), field, jitter=False)
    assert samples.sigma is not None
    assert samples.features is not None
    kept = [samples.t_starts, samples.sigma.detach(), samples.features.detach()]
    return [*kept, *test_trace.gradients(field, samples, torch.ones(len(samples), 17))]


def measured(judged: bool = True) -> dict[str, tuple[float, list[Tensor]]]:
    """The largest relative error, or NaN where it is not judged, and the result, of each operation."""
    torch.manual_seed(0)
    found: dict[str, tuple[float, list[Tensor]]] = {}
    for name, (compiled, reference, inputs, features) in differentiable().items():
        direction = torch.randn(len(compiled(*inputs)), features)
        ours = with_gradients(compiled, inputs, direction, torch.float32)
        found[name] = math.nan, ours
        if judged:
            with torch_on_one_thread():  # torch's threads wait for each other at every small operation
                truth = with_gradients(reference, inputs, direction, torch.float64)
            found[name] = largest_error(ours, truth), ours
    for name, form, reference in (
        ("dense Adam", dense_adam, dense_adam_reference),
        ("sparse Adam", sparse_adam, sparse_adam_reference),
    ):
        steps = optimised(form, torch.float32)
        found[name] = largest_error(steps, optimised(reference, torch.float64)) if judged else math.nan, steps
    *rows, pose = gaussians(COUNT)
    records = project_gaussians(*rows, seen_by(pose))[0]
    lists, samples = tile_lists(records, 150, 140), marched(CompiledMarch)
    density, cells = torch.rand(64**3).log().neg(), torch.empty(64**3, dtype=torch.bool)
    refresh_occupancy(density, cells, 0.95, 0.01, 0.01)
    t, weights, shift = torch.rand(2000, 17).cumsum(-1), torch.rand(2000, 16), torch.rand(2000)
    drawn = resample(t, weights, shift, 24, 1.0, 0.01)
    results = {"tile lists": list(lists[:4]), "marching": samples, "trace": traced()}
    results["occupancy"] = [density, cells.float()]
    found |= {name: (math.nan, tensors) for name, tensors in {**results, "resampling": [drawn]}.items()}
    if not judged:
        return found
    boxes, expected = tile_lists_reference(records, 150, 140), marched(ReferenceMarch)
    entries, allowed = (
        torch.repeat_interleave(each.offsets.diff().long()) * COUNT + each.ids for each in (lists, boxes)
    )
    missing = [len(expected[0]) - len(samples[0]), *(int((a != b).sum()) for a, b in [(samples[1], expected[1])])]
    alpha = -torch.expm1(-density.double() * 0.01)
    wrong = cells != ~(alpha < min(0.01, float(alpha.mean()) * (1 - 1e-5)))
    truth = resample_reference(t.double(), weights.double(), shift.double(), 24, 1.0, 0.01)
    errors = {
        "tile lists": float((~torch.isin(entries, allowed)).float().mean()),
        "marching": float(sum(map(abs, missing))) / len(expected[0]),
        "trace": largest_error(found["trace"][1], traced(wave_by_wave=True)),
        "occupancy": float(wrong.float().mean()),
        "resampling": relative_error(drawn, truth),
    }
    return found | {name: (error, found[name][1]) for name, error in errors.items()}


def largest_error(found: list[Tensor], truth: list[Tensor]) -> float:
    return max(relative_error(a, b) for a, b in zip(found, truth, strict=True))


def bits(results: dict[str, tuple[float, list[Tensor]]]) -> str:
    """A hash of all results, which is another if a bit is."""
    digest = hashlib.sha256()
    for _, tensors in results.values():
        for tensor in tensors:
            digest.update(tensor.detach().contiguous().numpy().tobytes())
    return digest.hexdigest()


if __name__ == "__main__":
    if len(sys.argv) > 1:
        torch.set_num_threads(int(sys.argv[1]))
    print(json.dumps({"threads": torch.get_num_threads(), "bits": bits(measured(judged=False))}))

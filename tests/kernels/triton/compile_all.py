"""All kernels, compiled for a GPU that need not be there: `python -m tests.kernels.triton.compile_all cuda 80`.

The interpreter accepts code that the compiler refuses, such as a variable that changes its type in a loop.
"""

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from triton.backends.compiler import GPUTarget
from triton.runtime.driver import driver
from triton.runtime.jit import JITFunction

from nerfloom.geometry.rays import Samples
from nerfloom.kernels import triton_launch
from nerfloom.kernels.adam import adam_triton
from nerfloom.kernels.compositing import density_triton
from nerfloom.kernels.encodings import encodings_triton, integrated_directional_triton
from nerfloom.kernels.grids import hash_grid_triton, planes_triton
from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout
from nerfloom.kernels.grids.planes_layout import PlanesLayout
from nerfloom.kernels.histograms import intervals_triton
from nerfloom.kernels.images import ssim_triton
from nerfloom.kernels.march import fixed_slots, fixed_slots_triton, waves_triton
from nerfloom.kernels.march.fixed_slots import share_out
from nerfloom.kernels.octree import trace_triton
from nerfloom.kernels.octree.layout import OctreeLayout
from nerfloom.kernels.octree.packed import CODES, PackedLeaves
from nerfloom.kernels.splats import blend_triton, project_triton, tiles_triton
from nerfloom.kernels.splats.project import SplatCamera, project_reference
from nerfloom.kernels.splats.tiles import tile_lists_reference
from nerfloom.kernels.surfaces import distance_triton, samples_triton
from nerfloom.kernels.surfaces.samples import FirstShape, Intervals
from tests.kernels.test_march import occupancy, random_rays


class Machine:
    """The answers of a driver about a GPU that there is code for, and nothing to run it on."""

    def __init__(self, target: GPUTarget) -> None:
        self.get_current_target = lambda: target
        self.get_current_device = lambda: 0
        self.get_current_stream = lambda device=0: 0


compiled: set[str] = set()


def compile_only(kernel: JITFunction, programs: tuple[int, ...]) -> Callable[..., Any]:
    """A launcher that only compiles its kernel."""

    def run(*arguments: Any, **constants: Any) -> Any:
        found = kernel.warmup(*arguments, grid=programs, **constants)
        compiled.add(f"{kernel.fn.__module__.split('.')[-1]}.{kernel.fn.__name__}")
        return found

    return run


def learned(*shape: int) -> Tensor:
    return torch.rand(shape, requires_grad=True)


def back(*results: Tensor) -> None:
    sum(result.sum() for result in results if result.requires_grad).backward()


def compile_all() -> None:
    offsets = torch.tensor([0, 3, 3, 8])
    samples = Samples(torch.rand(8), torch.rand(8), offsets)
    back(*density_triton.composite(samples, learned(8), learned(8, 3), torch.rand(3, 3), torch.rand(3)))
    density_triton.composite(replace(samples, points=torch.rand(8)), learned(8), torch.rand(8, 3), torch.rand(3, 3),
                          torch.rand(3))  # fmt: skip
    back(density_triton.distortion(learned(8), samples))
    grid = HashGridLayout.build(2, 4, 40, 8)
    for features in (1, 2):
        back(hash_grid_triton.hash_grid(learned(9, 3), learned(grid.num_entries, features), grid, None))
        weights = learned(8, 2 * features), learned(3, 8)
        back(
            distance_triton.distance_network(
                torch.rand(9, 3), learned(grid.num_entries, features), *weights, grid, None
            )
        )
    shape = FirstShape(torch.rand(3), torch.rand(3), 1.0, 0.9, 1e-3, torch.rand(4))
    along = Intervals(torch.rand(9, 3), torch.rand(9), 0.4)
    for intervals in (None, along):
        slope = torch.tensor(9.0, requires_grad=True)
        back(torch.cat(
            [each.reshape(-1) for each in samples_triton.surface_samples(
                learned(9, 8), slope, torch.rand(9, 3), shape, intervals)]
        ))  # fmt: skip
    back(samples_triton.unit_normals(learned(9, 7)))
    layout = PlanesLayout.build(((5, 6, 7), (8, 9, 10)))
    back(planes_triton.planes(learned(9, 3), learned(layout.num_entries, 6), layout, None))
    encodings_triton.spherical_harmonics(torch.rand(9, 3), 4)
    back(integrated_directional_triton.directional_encoding(learned(9, 3), learned(9), 5))
    back(encodings_triton.frequency_encoding(learned(9, 3), 4, True))
    back(encodings_triton.contract_to_unit(learned(9, 3), torch.rand(2, 3)))
    back(intervals_triton.interval_weights(learned(5, 9), torch.rand(5, 10)))
    intervals_triton.resample(torch.rand(5, 10), torch.rand(5, 9), torch.rand(5), 7, 0.5, 0.01)
    back(intervals_triton.proposal_excess(torch.rand(5, 10), torch.rand(5, 9), torch.rand(5, 8), learned(5, 7)))
    for found_inf in (None, torch.rand(())):
        adam_triton.sparse_adam(*torch.rand(4, 9, 2), torch.rand(9), 0.01, (0.9, 0.99), 1e-15, found_inf)
    for weights in (None, torch.rand(13, 15)):
        back(ssim_triton.photometric_loss(learned(13, 15, 3), torch.rand(13, 15, 3), 0.2, weights))
    gaussians()
    marching()
    octrees()


def gaussians() -> None:
    rows = [torch.randn(20, width) for width in (3, 3, 4)] + [torch.randn(20), torch.randn(20, 3)]
    camera = SplatCamera(torch.eye(3, 4), (30.0, 32.0, 20.0, 15.0), 37, 30)
    for count, antialiased in ((0, False), (15, True)):
        pose = torch.eye(3, 4, requires_grad=antialiased)
        view = replace(camera, pose=pose, antialiased=antialiased)
        leaves = [row.clone().requires_grad_() for row in (*rows, torch.rand(20, 3, count))]
        back(project_triton.project_gaussians(*leaves, view, count)[0])
    records = project_reference(*rows, torch.zeros(20, 3, 0), camera, 0)[0]
    lists = tile_lists_reference(records, 37, 30)
    for channels in (3, 4):
        shown = records.clone().requires_grad_()
        back(*blend_triton.blend(shown, lists, 37, 30, torch.rand(3), channels, False)[:2])
    blend_triton.blend(records, lists, 37, 30, torch.rand(3), 7, True)
    counts, keys = torch.zeros(20, dtype=torch.int32), torch.zeros(9, dtype=torch.int64)
    for given in ((counts, None, None, None), (None, keys, keys, counts)):
        triton_launch.launch(
            tiles_triton._list, (1,), records, records[:, 0].contiguous(), *given, 20, 3, 2, BLOCK=32, num_warps=1
        )


def marching() -> None:
    def four_each(counts: Tensor, _: Any) -> Tensor:
        return torch.arange(len(counts) + 1) * 4

    for cone, shift in ((0.0, None), (1 / 64, torch.rand(33))):
        marched = waves_triton.TritonMarch(random_rays(33), occupancy(8, 0.5), 0.1, cone, shift, 0.01)
        with patch.object(waves_triton.functional, "pad", four_each):
            wave = marched.wave(4)
        assert wave is not None
        marched.advance(torch.ones(len(wave.owners)))
    nothing = partial(share_out, torch.zeros(33, dtype=torch.int64))
    with patch.object(fixed_slots, "share_out", lambda counts, capacity: nothing(capacity)):  # nothing was counted
        filled = fixed_slots_triton.fill(random_rays(33), occupancy(8, 0.5), 0.1, 30, torch.rand(33), (0, 512))
    fixed_slots_triton.reach(filled.placed, torch.rand(512), 4.6, 30)


def octrees() -> None:
    """Octrees of one level and of two, with and without a choice by the width of pixels."""
    rays, leaves = random_rays(33), torch.tensor([[1, 2, 3], [4, 5, 6]])
    inner, _ = OctreeLayout.build(torch.zeros(3), 0.1, (1, 1, 1), leaves)
    outer, _ = OctreeLayout.build(inner.around(), 0.2, (1, 1, 1), leaves)
    for layout in (inner, inner.within([outer])):
        count, peaks = layout.num_leaves, torch.rand(layout.num_leaves)
        for width in (3, 12, 27, 48):
            back(*trace_triton.trace_octree(layout, learned(count, 1), learned(count, width), rays, torch.rand(33, 3)))
        trace_triton.trace_octree(
            layout, torch.rand(count, 1), torch.rand(count, 3), rays, torch.rand(33, 3), 0.1, None, peaks
        )
        codes, colors = torch.zeros(count, dtype=torch.uint8), torch.zeros(count, 12, dtype=torch.uint8)
        packed = PackedLeaves(codes, torch.rand(CODES * len(layout.levels)), colors, torch.rand(12), torch.rand(12))
        for radii in (None, torch.rand(33)):
            trace_triton.trace_packed(layout, packed, replace(rays, pixel_radii=radii), torch.rand(33, 3))
        trace_triton.raise_weights(layout, torch.rand(count, 1), rays, peaks)


if __name__ == "__main__":
    kind, name = sys.argv[1], sys.argv[2]
    target = GPUTarget(kind, int(name), 32) if kind == "cuda" else GPUTarget(kind, name, 64)
    driver.set_active(Machine(target))
    JITFunction.__getitem__ = compile_only  # type: ignore[method-assign]
    compile_all()
    print(f"{len(compiled)} kernels compiled for {kind} {name}:", *sorted(compiled))

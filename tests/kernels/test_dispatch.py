"""The table of operations: the choice of an implementation, each one against its reference, and additions."""

import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

from nerfloom.cameras.cameras import CAMERA_RAYS, Cameras, subpixels
from nerfloom.cameras.rigid_motion import RIGID_MOTIONS
from nerfloom.data.pixels.batch import GATHER_COLORS, VIEW_COLORS
from nerfloom.geometry.multisamples import Pattern
from nerfloom.geometry.points import Frustums
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels import dispatch, native
from nerfloom.kernels.adam.adam import ALL_FINITE, DENSE_ADAM, SPARSE_ADAM
from nerfloom.kernels.adam.row_gradient import TABLE_ROWS
from nerfloom.kernels.compositing.density import COMPOSITE, DISTORTION
from nerfloom.kernels.dispatch import TRITON, Backend, Operation, derivatives
from nerfloom.kernels.encodings.contraction import CONTRACT
from nerfloom.kernels.encodings.frequency import FREQUENCY_ENCODING
from nerfloom.kernels.encodings.integrated_directional import DIRECTIONAL_ENCODING
from nerfloom.kernels.encodings.spherical_harmonics import SPHERICAL_HARMONICS
from nerfloom.kernels.grids.hash_grid import HASH_GRID, hash_grid
from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout
from nerfloom.kernels.grids.hash_grid_tangent import HASH_GRID_TANGENT
from nerfloom.kernels.grids.multisampled_grid import MULTISAMPLED_GRID
from nerfloom.kernels.grids.multisamples import FRUSTUM_BALLS, UNIT_MULTISAMPLES
from nerfloom.kernels.grids.plane_bands import BAND_VARIATION, PLANE_BANDS
from nerfloom.kernels.grids.planes import PLANES, PlanesGradient
from nerfloom.kernels.grids.planes_layout import PlanesLayout
from nerfloom.kernels.histograms.intervals import INTERVAL_WEIGHTS, PROPOSAL_EXCESS, RESAMPLE
from nerfloom.kernels.histograms.proposals import PROPOSAL_WEIGHTS
from nerfloom.kernels.histograms.spacing import SPACED
from nerfloom.kernels.histograms.step_functions import BLURRED_EXCESS
from nerfloom.kernels.images.silhouettes import HOLD_BALLS, OPAQUE_SUMS, PIXELS_NEAR_BALLS, Photograph, opaque_sums
from nerfloom.kernels.images.ssim import PHOTOMETRIC, SIMILARITY
from nerfloom.kernels.march.first_covisible import CELLS, FIRST_COVISIBLE, LEVELS
from nerfloom.kernels.march.fixed_slots import FILL, REACH, fill
from nerfloom.kernels.march.occupancy import REFRESH_OCCUPANCY, Occupancy
from nerfloom.kernels.march.ray_order import SORT_BY_RAY
from nerfloom.kernels.march.waves import MARCH, March, march
from nerfloom.kernels.networks.grouped import GROUPED_DENSITY_NETWORK, GROUPED_NETWORK
from nerfloom.kernels.networks.mlp import DENSITY_NETWORK, NETWORK
from nerfloom.kernels.octree.layout import OctreeLayout
from nerfloom.kernels.octree.packed import TRACE_PACKED, PackedLeaves
from nerfloom.kernels.octree.trace import TRACE_OCTREE
from nerfloom.kernels.octree.weights import RAISE_WEIGHTS
from nerfloom.kernels.rows import GATHER_ROWS
from nerfloom.kernels.splats.blend import BLEND
from nerfloom.kernels.splats.packed import PROJECT_PACKED, pack_gaussians
from nerfloom.kernels.splats.project import PROJECT, RECORD, Record, SplatCamera, project_gaussians
from nerfloom.kernels.splats.tiles import TILES, tile_lists
from nerfloom.kernels.surfaces.crossings import MARCHED_CROSSINGS
from nerfloom.kernels.surfaces.distance import DISTANCE_NETWORK
from nerfloom.kernels.surfaces.samples import SURFACE_SAMPLES, UNIT_NORMALS, FirstShape, Intervals
from nerfloom.kernels.surfaces.signed_distance import SIGNED_DISTANCES, SignedDistance
from nerfloom.kernels.traced.colors import TRACED_COLORS, GridColor
from nerfloom.kernels.traced.squared_error import TRACED_ERROR, PixelTargets
from nerfloom.kernels.traced.trace import TRACE, GridDensity
from tests.kernels.compiled import needs_kernels

GRID = HashGridLayout.build(3, 4, 20, 8)
LAYOUT = PlanesLayout.build(((5, 6, 7), (8, 9, 10)))
OFFSETS = torch.tensor([0, 3, 3, 8, 12])
BOX = torch.tensor([[-1.0, -1.5, -1.0], [1.0, 1.0, 2.0]])
Arguments = tuple[Any, ...]


def rand(*shape: int) -> Tensor:
    return torch.rand(shape) + 0.1


def edges(rays: int, bins: int) -> Tensor:
    return torch.linspace(0, 1, bins + 1) + 0.01 * torch.rand(rays, bins + 1).cumsum(-1)


def samples() -> Samples:
    ends = rand(12).cumsum(0)
    return Samples(ends - 0.1, ends, OFFSETS)


def unit(count: int) -> Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)


def rays() -> Rays:
    origins = 4 * unit(100)
    directions = torch.nn.functional.normalize(torch.rand(100, 3) * 3 - 1.5 - origins, dim=-1)
    return Rays(origins, directions, torch.full((100,), 0.1), torch.full((100,), 20.0))


def cameras() -> Cameras:
    poses = torch.eye(3, 4).expand(2, 3, 4) + 0.1 * rand(2, 3, 4)
    six = torch.full((2,), 6)
    return Cameras(poses, 5 + rand(2), 5 + rand(2), 3 + rand(2), 3 + rand(2), six, six)


def frustums() -> Frustums:
    starts = rand(50)
    return Frustums(torch.randn(50, 3), unit(50), starts, starts + rand(50), 0.1 * rand(50))


def marched() -> March:
    return march(rays(), Occupancy(torch.rand(16**3) < 0.1, BOX, 16), 0.05, 0.0, None, 1e-2)


def grid_density() -> GridDensity:
    size = BOX[1] - BOX[0]
    table, weights = 4 * torch.rand(GRID.num_entries, 2) - 2, [torch.randn(8, 6), torch.randn(5, 8)]
    return GridDensity(1 / size, -BOX[0] / size, table, GRID, None, weights)


def signed_distance() -> SignedDistance:
    """A ball on a floor, with a little of a network's output."""
    scale = 1 / (BOX[1] - BOX[0])
    floor = torch.tensor([0.0, 0.6, 0.8, -0.5])
    shape = FirstShape(torch.tensor([0.0, 0.0, 0.5]), scale, 1.0, 0.7, 1e-3, floor)
    weights = torch.randn(8, 6), torch.randn(5, 8)
    return SignedDistance(-BOX[0] * scale, 1e-3 * torch.randn(GRID.num_entries, 2), GRID, *weights, shape)


def through_a_box(count: int) -> March:
    """A march of some rays with all steps occupied."""
    occupied = torch.ones(16**3, dtype=torch.bool)
    return march(rays()[:count], Occupancy(occupied, BOX, 16), 0.05, 0.0, None, 0.0)


def octree() -> OctreeLayout:
    """40 leaves around the origin."""
    cells = torch.stack([torch.arange(40) % 7, torch.arange(40) % 11, torch.arange(40) % 13], -1)
    return OctreeLayout.build(torch.full((3,), -1.0), 0.125, (2, 2, 2), cells + 1)[0]


def packed_leaves() -> PackedLeaves:
    codes, colors = (torch.randint(256, shape, dtype=torch.uint8) for shape in ((40,), (40, 27)))
    return PackedLeaves(codes, torch.linspace(0, 0.1, 256), colors, rand(27) / 255, rand(27))


def excluded() -> Tensor:
    return torch.cat([torch.rand(LEVELS * CELLS**3) < 0.8, torch.tensor([False])])


def grid_color() -> GridColor:
    return GridColor(2, [torch.randn(8, 9), torch.randn(3, 8)])


def photograph() -> Photograph:
    pose = torch.cat([torch.eye(3), torch.tensor([[0.0], [0.0], [4.0]])], dim=-1)
    return Photograph(pose, 60.0, 55.0, 26.0, 19.0, opaque_sums(torch.rand(40, 50) > 0.97))


def gaussians() -> tuple[Tensor, ...]:
    """Rows in front of `splat_camera`, with harmonics of degree 1."""
    means = torch.randn(40, 3) + torch.tensor([0.0, 0.0, 4.0])
    return means, torch.randn(40, 3) / 2 - 2, torch.randn(40, 4), torch.randn(40), torch.randn(40, 3), rand(40, 3, 3)


def splat_camera() -> SplatCamera:
    return SplatCamera(torch.eye(3, 4), (30.0, 32.0, 20.0, 15.0), 37, 30)


def projected() -> Tensor:
    return project_gaussians(*gaussians(), splat_camera())[0]


def everywhere(left: int, right: int) -> Tensor:
    """Records that meet all tiles of an image of 32 x 32; some are not visible, and many are at equal distances."""
    records = torch.zeros(60, RECORD)
    records[:, :2], records[:, [Record.U_X, Record.V_Y]] = 32 * torch.rand(60, 2), 1.0
    records[:, Record.CUT], records[:, [Record.REACH_X, Record.REACH_Y]] = 1e5 * torch.rand(60) - 2e4, 40.0
    records[:, Record.DISTANCE] = torch.randint(left, right, (60,)).float()
    return records


def grouped(outputs: int) -> Arguments:
    """Rows, the network of each, and six networks 7-8-`outputs`; two of these have no rows."""
    owners = torch.tensor([0, 1, 3, 5])[torch.randint(4, (60,))]
    return [rand(60, 5), rand(60, 2)], owners, rand(6, 64 + 9 * outputs) - 0.6, (7, 8, outputs)


def adam(parameters: int) -> Arguments:
    """Values, gradients, means, squares."""
    return tuple([rand(20, 2) for _ in range(parameters)] for _ in range(4))


RATES = 0.01, (0.9, 0.99), 1e-15
CASES: dict[Operation[..., Any], Callable[[], Arguments]] = {
    HASH_GRID: lambda: (torch.rand(50, 3), rand(GRID.num_entries, 2), GRID, None),
    HASH_GRID_TANGENT: lambda: (torch.rand(50, 6), rand(GRID.num_entries, 2), GRID),
    DISTANCE_NETWORK: lambda: (torch.rand(50, 3), rand(GRID.num_entries, 2), rand(8, 6) - 0.6, rand(3, 8), GRID, None),
    SURFACE_SAMPLES: lambda: (
        rand(50, 8),
        rand(1)[0] + 3,
        torch.rand(50, 3),
        FirstShape(rand(3), rand(3), 0.5, 0.3, 1e-3, rand(4)),
        Intervals(torch.nn.functional.normalize(torch.randn(50, 3), dim=-1), rand(50), 0.4),
    ),
    UNIT_NORMALS: lambda: (rand(50, 7),),
    SIGNED_DISTANCES: lambda: (3 * torch.rand(50, 3) - 1, signed_distance()),
    MARCHED_CROSSINGS: lambda: (through_a_box(12), signed_distance(), 0.02, 1.25),
    MULTISAMPLED_GRID: lambda: (rand(50, 1, 4), rand(GRID.num_entries, 2), GRID, None),
    UNIT_MULTISAMPLES: lambda: (frustums(), Pattern(6 * rand(50), torch.ones(50)), BOX, True),
    FRUSTUM_BALLS: lambda: (frustums(), BOX, True),
    PLANES: lambda: (torch.rand(50, 3), rand(LAYOUT.num_entries, 4), LAYOUT, None),
    PLANE_BANDS: lambda: (rand(LAYOUT.num_entries, 4), ((10, 4, 5), (50, 1, 5)), PlanesGradient(LAYOUT)),
    BAND_VARIATION: lambda: (rand(LAYOUT.num_entries, 4), ((10, 4, 5), (50, 1, 5)), PlanesGradient(LAYOUT)),
    NETWORK: lambda: ([rand(9, 5), rand(9, 2)], [rand(8, 7), rand(3, 8)], "sigmoid", [rand(8), rand(3)]),
    DENSITY_NETWORK: lambda: ([rand(40, 5), rand(40, 2)], [rand(8, 7), rand(3, 8) * 9 - 5], [rand(8), rand(3)]),
    GROUPED_NETWORK: lambda: (*grouped(3), "sigmoid", None),
    GROUPED_DENSITY_NETWORK: lambda: (*grouped(5), None),
    FREQUENCY_ENCODING: lambda: (rand(9, 3), 4, True),
    SPHERICAL_HARMONICS: lambda: (unit(9), 4),
    DIRECTIONAL_ENCODING: lambda: (unit(9), 3 * torch.rand(9), 5),
    CONTRACT: lambda: (5 * torch.randn(40, 3), BOX),
    COMPOSITE: lambda: (samples(), rand(12), rand(12, 3), rand(4, 3), 5 * rand(4)),
    DISTORTION: lambda: (rand(12), samples()),
    INTERVAL_WEIGHTS: lambda: (rand(6, 9), edges(6, 9)),
    RESAMPLE: lambda: (edges(6, 9), rand(6, 9), torch.rand(6), 5, 0.7, 0.01),
    SPACED: lambda: (torch.rand(6, 9), torch.rand(6), 3 + rand(6), 0.9),
    FIRST_COVISIBLE: lambda: (rays(), BOX, excluded()),
    PROPOSAL_WEIGHTS: lambda: (rays(), edges(100, 9), grid_density()),
    PROPOSAL_EXCESS: lambda: (edges(6, 9), rand(6, 9), edges(6, 4), rand(6, 4) / 10),
    BLURRED_EXCESS: lambda: (edges(6, 9), rand(6, 9), edges(6, 4), rand(6, 4) / 10, 0.03),
    SPARSE_ADAM: lambda: (*(t for (t,) in adam(1)), torch.zeros(20), *RATES),
    DENSE_ADAM: lambda: (*adam(3), [torch.full((), float(step)) for step in (0, 3, 9)], *RATES),
    TABLE_ROWS: lambda: (rand(9, 4), torch.tensor([0, 3, 5]), None),
    ALL_FINITE: lambda: ([torch.ones(2), torch.tensor([1.0, torch.inf])],),
    GATHER_ROWS: lambda: ([[rand(4, 3), rand(5, 3)], [torch.arange(4), torch.arange(5)]], torch.tensor([8, 0, 4, 3])),
    SORT_BY_RAY: lambda: (torch.randint(5, (30,)), torch.randint(2, (30,), dtype=torch.uint8), 5),
    MARCH: lambda: (rays(), Occupancy(torch.rand(16**3) < 0.1, BOX, 16), 0.05, 0.0, None, 1e-3),
    FILL: lambda: (rays(), Occupancy(torch.rand(16**3) < 0.1, BOX, 16), 0.05, 100, None, (2048, 2048)),
    REACH: lambda: (fill(*CASES[FILL]()).placed, rand(2048), 4.6, 100),
    TRACE: lambda: (marched(), grid_density()),
    TRACE_OCTREE: lambda: (octree(), rand(40, 1) - 4, rand(40, 12), rays(), rand(100, 3)),
    TRACE_PACKED: lambda: (octree(), packed_leaves(), rays(), rand(100, 3)),
    RAISE_WEIGHTS: lambda: (octree(), rand(40, 1) - 4, rays(), torch.zeros(40)),
    TRACED_COLORS: lambda: (marched(), grid_density(), grid_color(), rand(100, 3)),
    TRACED_ERROR: lambda: (marched(), grid_density(), grid_color(), PixelTargets(rand(100, 3), rand(25, 3), rand(25))),
    REFRESH_OCCUPANCY: lambda: (torch.rand(200) * 0.4, torch.zeros(200, dtype=torch.bool), 0.9, 0.05, 0.01),
    OPAQUE_SUMS: lambda: (torch.rand(7, 9) > 0.5,),
    HOLD_BALLS: lambda: (photograph(), torch.rand(200, 3) * 2 - 1, 0.05, torch.rand(200) > 0.5, True),
    PIXELS_NEAR_BALLS: lambda: (photograph(), torch.rand(20, 3) * 2 - 1, 0.05),
    PROJECT: lambda: (*gaussians(), splat_camera(), 3),
    PROJECT_PACKED: lambda: (pack_gaussians(*(rows[:32] for rows in gaussians())), splat_camera(), 3),
    TILES: lambda: (everywhere(1, 9), 32, 32, True),
    BLEND: lambda: (records := projected(), tile_lists(records, 37, 30), 37, 30, rand(3), 7, True),
    PHOTOMETRIC: lambda: (rand(13, 15, 3), rand(13, 15, 3), 0.2),
    SIMILARITY: lambda: (rand(13, 15, 3), rand(13, 15, 3), rand(3, 5) < 0.5, True),
    GATHER_COLORS: lambda: (torch.randint(256, (60, 4), dtype=torch.uint8), torch.randint(60, (9,)), rand(9, 3)),
    VIEW_COLORS: lambda: (torch.randint(256, (7, 9, 4), dtype=torch.uint8), rand(3)),
    RIGID_MOTIONS: lambda: (torch.randn(9, 6), True),
    CAMERA_RAYS: lambda: (cameras(), torch.arange(0, 72, 5), 0.0, 1.0, None, subpixels(4)),
}
"""Arguments of every operation that has more than a reference."""


def tensors_in(value: Any) -> list[Tensor]:
    """All tensors in arguments or results, and True or False as one."""
    if isinstance(value, March):
        while (wave := value.wave(8)) is not None:
            value.advance(torch.full_like(wave.t_starts, 3.0))
        order, offsets = value.finish()
        starts, owners = (torch.cat([getattr(w, name) for w in value.waves]) for name in ("t_starts", "owners"))
        return [starts[order], owners[order], offsets]
    if isinstance(value, Tensor):
        return [value]
    if isinstance(value, (bool, int)):
        return [torch.tensor(value)]
    if is_dataclass(value):
        return [tensor for field in fields(value) for tensor in tensors_in(getattr(value, field.name))]
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [tensor for item in value for tensor in tensors_in(item)]
    return []


def test_every_operation_is_compared_with_its_reference() -> None:
    listed = dispatch.table()
    assert all(names[-1] == "reference" for names in listed.values())
    assert {name for name, names in listed.items() if len(names) > 1} == {operation.name for operation in CASES}
    assert listed["hash_grid"] == ("c++", "triton", "few operations", "reference")
    assert listed["dense_adam"] == ("c++", "torch", "reference")


PAIRS = [  # Triton's are compared in tests/kernels/triton
    (operation, index)
    for operation in CASES
    for index, implementation in enumerate(operation.implementations)
    if implementation.backend is not TRITON
]


@pytest.mark.parametrize(
    ("operation", "index"), PAIRS, ids=[f"{o.name}-{o.implementations[i].backend.name}" for o, i in PAIRS]
)
def test_an_implementation_computes_what_its_reference_does(operation: Operation[..., Any], index: int) -> None:
    """Values, and tensors written in place, are compared. Gradients are compared in test_gradients_kept.py."""
    implementation = operation.implementations[index]
    if not implementation.backend.available():
        pytest.skip(f"{implementation.backend.name} cannot be used on this machine")
    found = []
    for run in (implementation.run, operation.reference.run):
        torch.manual_seed(0)
        arguments = CASES[operation]()
        with torch.no_grad():
            result = run(*arguments)
        given = [argument for argument in arguments if not isinstance(argument, March)]  # waves leave its state behind
        found.append(tensors_in(result) + tensors_in(given))
    assert len(found[0]) == len(found[1]) > 0
    for value, truth in zip(*found, strict=True):
        torch.testing.assert_close(value, truth, rtol=1e-4, atol=1e-5)


def taken(operation: Operation[..., Any], tensors: Sequence[Tensor | None], *arguments: Any) -> str:
    return operation.choose(tensors, *arguments).backend.name


@needs_kernels
def test_what_is_taken() -> None:
    """The choice depends on device, type, gradients, and the shapes that kernels support."""
    positions, table = torch.rand(9, 3), rand(GRID.num_entries, 2)

    def grid(positions: Tensor, table: Tensor) -> str:
        return taken(HASH_GRID, (positions, table), positions, table, GRID, None)

    assert grid(positions, table) == grid(positions.requires_grad_(), table.requires_grad_()) == "c++"
    assert grid(positions.double(), table.double()) == "reference"
    assert grid(positions.to("meta"), table) == grid(positions, table.to("meta")) == "reference"
    assert grid(positions.to("meta"), table.to("meta")) == "few operations"
    assert grid(positions, rand(GRID.num_entries, 3)) == "reference"
    line = torch.rand(4)
    assert taken(FREQUENCY_ENCODING, (line,), line, 3, True) == "reference"
    for width, layers, expected in ((384, 2, "c++"), (385, 2, "reference"), (8, 8, "c++"), (8, 9, "reference")):
        weights = [rand(width, width)] * layers
        inputs = [rand(4, width)]
        assert taken(NETWORK, (*inputs, *weights), inputs, weights, "none", None) == expected
    row = rand(4, 6)
    assert taken(ALL_FINITE, (row,), [row]) == "c++"
    assert taken(ALL_FINITE, (row.t(),), [row.t()]) == "reference"
    assert taken(PLANE_BANDS, (table,), table, ((0, 1, 1),), None) == "reference"
    assert taken(BAND_VARIATION, (table,), table, ((0, 1, 1),), None) == "reference"
    image = CASES[BLEND]()
    image[0].requires_grad_()
    for channels, expected in ((3, "c++"), (4, "c++"), (7, "reference")):
        assert taken(BLEND, image[:1], *image[:5], channels, False) == expected
    with torch.no_grad():
        assert taken(BLEND, image[:1], *image) == "c++"
    flat = cameras()
    fan = Cameras(*(getattr(flat, field.name) for field in fields(Cameras)[:7]), model="orthographic")
    for these, expected in ((flat, "c++"), (fan, "reference")):
        assert taken(CAMERA_RAYS, (these.fx,), these, torch.arange(3), 0.0, 1.0, None, subpixels(1)) == expected


@needs_kernels
@pytest.mark.parametrize(
    ("operation", "followed", "expected"),
    [
        (SPHERICAL_HARMONICS, 0, "c++"),
        (UNIT_MULTISAMPLES, 1, "c++"),
        (UNIT_MULTISAMPLES, 2, "reference"),
        (CONTRACT, 0, "c++"),
        (CONTRACT, 1, "reference"),
        (DENSITY_NETWORK, 0, "c++"),
        (DISTORTION, 0, "c++"),
        (DISTORTION, 1, "reference"),
        (DISTORTION, 2, "reference"),
        (PROJECT, 6, "c++"),
        (PHOTOMETRIC, 0, "c++"),
        (PHOTOMETRIC, 1, "reference"),
        (SIMILARITY, 0, "reference"),
        (COMPOSITE, 1, "c++"),
        (COMPOSITE, 2, "reference"),
        (COMPOSITE, 6, "reference"),
        (DISTANCE_NETWORK, 1, "c++"),
        (HASH_GRID_TANGENT, 0, "reference"),
        (HASH_GRID_TANGENT, 1, "reference"),
    ],
)
def test_no_gradient_is_dropped(operation: Operation[..., Any], followed: int, expected: str) -> None:
    """If an implementation has no gradient for a required input, torch computes the operation."""
    arguments, here = CASES[operation](), [rand(3) for _ in range(7)]
    here[followed].requires_grad_()
    assert taken(operation, here, *arguments) == expected
    with torch.no_grad():
        assert taken(operation, here, *arguments) == "c++"
    assert taken(operation, [None, *(t.detach() for t in here)], *arguments) == "c++"


def test_second_derivatives_are_the_references() -> None:
    positions, table = torch.rand(9, 3, requires_grad=True), rand(GRID.num_entries, 2)
    with derivatives(2):
        kind = "reference" if native.available() else "few operations"
        assert taken(HASH_GRID, (positions, table), positions, table, GRID, None) == kind
        assert taken(SPHERICAL_HARMONICS, (positions,), positions, 4) == kind
        with torch.no_grad():
            assert taken(HASH_GRID, (table, table), table, table, GRID, None) == (
                "c++" if native.available() else "few operations"
            )
        (slope,) = torch.autograd.grad(hash_grid(positions, table, GRID).square().sum(), positions, create_graph=True)
    (curvature,) = torch.autograd.grad(slope.square().sum(), positions)
    assert bool(curvature.any())
    if native.available():
        (slope,) = torch.autograd.grad(hash_grid(positions, table, GRID).square().sum(), positions, create_graph=True)
        with pytest.raises(RuntimeError, match="once_differentiable"):
            slope.square().sum().backward()


@needs_kernels
def test_the_order_of_derivatives_is_a_threads_and_ends_with_its_block() -> None:
    positions, table, seen = torch.rand(9, 3, requires_grad=True), rand(GRID.num_entries, 2), []

    def look() -> None:
        seen.append(taken(HASH_GRID, (positions, table), positions, table, GRID, None))

    def look_twice() -> None:
        with derivatives(2):
            thread = threading.Thread(target=look)
            thread.start()
            thread.join()
            look()
            raise KeyError

    with pytest.raises(KeyError):
        look_twice()
    look()
    assert seen == ["c++", "reference", "c++"]


@pytest.fixture
def elsewhere() -> Iterator[list[int]]:
    """A third backend, of a device that has none, which says how many rows it was asked for."""
    asked: list[int] = []

    def run(positions: Tensor, table: Tensor, layout: HashGridLayout, deferred: object) -> Tensor:
        asked.append(len(positions))
        return positions.new_zeros(len(positions), layout.num_levels * table.shape[1])

    HASH_GRID.implementation(Backend("elsewhere", lambda tensor: tensor.is_meta, lambda: True))(run)
    yield asked
    HASH_GRID.implementations[:] = [each for each in HASH_GRID.implementations if each.run is not run]


def test_a_third_backend_is_one_more_implementation(elsewhere: list[int]) -> None:
    """The operation's function and its callers stay as they are."""
    table = rand(GRID.num_entries, 2)
    hash_grid(torch.rand(4, 3), table, GRID)
    assert elsewhere == []
    out = hash_grid(torch.rand(5, 3, device="meta"), table.to("meta"), GRID)
    assert elsewhere == [5]
    assert out.is_meta
    assert dispatch.table()["hash_grid"] == ("c++", "triton", "elsewhere", "few operations", "reference")

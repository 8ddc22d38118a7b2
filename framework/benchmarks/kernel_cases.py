"""Inputs of every operation with a Triton kernel: random, extreme and empty ones.

An extreme input has values that are rare in a run but must be survived: unbounded densities and lengths, exhausted
light, positions on faces, outside and infinitely far, rays that miss, Gaussians behind the camera or without size. A
case is a function of named tensors; their type and device determine the implementation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nerfloom.benchmarks.octree_cases import in_octrees
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.adam.adam import sparse_adam
from nerfloom.kernels.compositing.density import composite, distortion
from nerfloom.kernels.encodings.contraction import contract_to_unit
from nerfloom.kernels.encodings.frequency import frequency_encoding
from nerfloom.kernels.encodings.integrated_directional import directional_encoding
from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics
from nerfloom.kernels.grids.hash_grid import hash_grid
from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout
from nerfloom.kernels.grids.planes import planes
from nerfloom.kernels.grids.planes_layout import PlanesLayout
from nerfloom.kernels.histograms.intervals import interval_weights, proposal_excess, resample
from nerfloom.kernels.images.ssim import photometric_loss
from nerfloom.kernels.march.fixed_slots import Placed, fill, reach, share_out
from nerfloom.kernels.march.occupancy import Occupancy
from nerfloom.kernels.march.ray_order import sort_by_ray
from nerfloom.kernels.march.waves import march
from nerfloom.kernels.splats.blend import blend
from nerfloom.kernels.splats.project import RECORD, Record, SplatCamera, project_gaussians
from nerfloom.kernels.splats.tiles import TileLists, tile_lists, tile_lists_reference
from nerfloom.kernels.surfaces.distance import distance_network
from nerfloom.kernels.surfaces.samples import FirstShape, Intervals, surface_samples, unit_normals

Inputs = dict[str, Tensor]
KINDS = ("random", "extreme", "empty")
GRID = HashGridLayout.build(2, 4, 40, 8)  # a dense level and a hashed one
LAYOUT = PlanesLayout.build(((5, 6, 7), (2, 9, 10)))
BOX = torch.tensor([[-1.0, -1.5, -1.0], [1.0, 1.0, 2.0]])
PLACES = (0.0, 1.0, -1e30, 1e30, 1 - 2**-24, 2**-149)
"""Coordinates on faces, next to them, and far away."""
STEPS, CELLS = 40, 8
"""Steps along the diagonal of a marched box, and its cells along an axis."""
STEP = float((BOX[1] - BOX[0]).norm()) / STEPS
WIDTH, HEIGHT = 37, 30
BOUNDS = slice(Record.CUT, Record.RED)
"""Columns of records with sums of absolute gradients as gradients."""
WIDTHS, REACHES = [Record.U_X, Record.V_Y], [Record.REACH_X, Record.REACH_Y]


@dataclass(frozen=True)
class Case:
    """An operation with given inputs."""

    kernel: str
    """Name of the operation in the table of operations."""
    kind: str
    """random, extreme or empty."""
    run: Callable[..., Sequence[Tensor]]
    """The operation, as a function of the inputs by name."""
    inputs: Inputs
    """The inputs, float32 on the CPU."""
    followed: str = ""
    """Names of the inputs with compared gradients."""


def cases() -> Iterator[Case]:
    """Yield all cases, grouped by operation."""
    torch.manual_seed(0)
    families = (*_along_rays(), *_at_points(), *_marched(), *_projected(), *_on_images(), *in_octrees())
    for kernel, run, followed, inputs in families:
        for kind, given in zip(KINDS, inputs, strict=True):
            yield Case(kernel, kind, run, given, followed if kind != "empty" else "")


Family = tuple[str, Callable[..., Sequence[Tensor]], str, tuple[Inputs, Inputs, Inputs]]


def _rays(counts: list[int]) -> Inputs:
    count, rays = sum(counts), len(counts)
    starts = torch.rand(count).cumsum(0) / 4
    return {
        "sigma": torch.rand(count) * 10 / max([*counts, 1]), "rgb": torch.rand(count, 3), "starts": starts,
        "ends": starts + torch.rand(count) / 4, "background": torch.rand(rays, 3), "fars": torch.full((rays,), 1e3),
        "offsets": torch.tensor([0, *counts], dtype=torch.float32).cumsum(0),
    }  # fmt: skip


def _samples(starts: Tensor, ends: Tensor, offsets: Tensor) -> Samples:
    return Samples(starts, ends, offsets.long())


def _along_rays() -> Iterator[Family]:
    """Compositing, distortion, histograms."""

    def composited(
        sigma: Tensor, rgb: Tensor, starts: Tensor, ends: Tensor, background: Tensor, fars: Tensor, offsets: Tensor
    ) -> Sequence[Tensor]:
        found = composite(_samples(starts, ends, offsets), sigma, rgb, background, fars)
        return found.color, found.opacity, found.weights, found.moment, found.median

    hard = _rays([6, 6, 6])
    inf = math.inf
    hard["sigma"] = torch.tensor([1e9, 1, 1e9, 0, 3, 1, 1e-9, 1e-20, 1e-38, 1e-8, 0, 1e-9, inf, 1, 2, inf, 0, 1])
    hard["ends"][1], hard["ends"][11] = hard["starts"][1], inf
    yield "composite", composited, "sigma rgb", (_rays([5, 0, 33, 64, 1]), hard, _rays([0, 0]))

    def distorted(weights: Tensor, starts: Tensor, ends: Tensor, offsets: Tensor) -> Sequence[Tensor]:
        return (distortion(weights, _samples(starts, ends, offsets)),)

    def weighted(counts: list[int], away: float = 0.0) -> Inputs:
        given = _rays(counts)
        starts, ends = given["starts"] + away, given["ends"] + away
        return {"weights": given["sigma"], "starts": starts, "ends": ends, "offsets": given["offsets"]}

    inputs = weighted([5, 0, 33, 70]), weighted([5, 0, 33], away=1e3), weighted([0, 0])
    yield "distortion", distorted, "weights", inputs

    def edges(rays: int, bins: int) -> Tensor:
        return torch.rand(rays, bins + 1).sort(-1).values

    t = torch.tensor([[0.0, 1, 2, 2, 3], [0, 1, 1, 2, inf]])
    odd = {"sigma": torch.tensor([[0.0, inf, 1, inf], [1e9, 0, 1e-30, 0]]), "t": t}
    many = {"sigma": torch.rand(3, 130) * torch.tensor([[1e4], [1], [1e-6]]), "t": edges(3, 130)}
    nothing = {"sigma": torch.rand(0, 5), "t": edges(0, 5)}
    yield "interval_weights", lambda sigma, t: (interval_weights(sigma, t),), "sigma", (many, odd, nothing)

    def resampled(edges: Tensor, weights: Tensor, shift: Tensor) -> Sequence[Tensor]:
        return (resample(edges, weights, shift, 40, 1.0, 0.0),)

    few = torch.tensor([[0.0, 0, 0, 0], [0, 1e-30, 0, 0], [0, 1, 1e-9, 0], [1, 0, 0, 1e30]])
    line = torch.tensor([0.0, 1, 1, 2, 3]).repeat(4, 1)
    usual, hard, none = (
        {"edges": e, "weights": w, "shift": torch.linspace(0, 0.75, len(w))}
        for e, w in ((edges(3, 130), torch.rand(3, 130) ** 4), (line, few), (edges(0, 4), torch.rand(0, 4)))
    )
    yield "resample", resampled, "", (usual, hard, none)

    def excess(edges: Tensor, weights: Tensor, proposed: Tensor, others: Tensor) -> Sequence[Tensor]:
        return (proposal_excess(edges, weights, proposed, others),)

    line = torch.tensor([0.0, 1, 1, 2]).repeat(4, 1)
    hard = {
        "edges": line, "weights": torch.tensor([[0.5, 0, 0.5], [0.0, 0, 0], [1, 1e-30, 0], [0.2, 0.3, 0.5]]),
        "proposed": torch.stack([line[0], line[0], line[0], line[0] + 9]),
        "others": torch.tensor([[0.0, 0, 0], [1.0, 1, 1], [0.1, 0.2, 0.3], [1.0, 1, 1]]),
    }  # fmt: skip
    usual, none = (
        {"edges": edges(n, 65), "weights": torch.rand(n, 65) / 65, "proposed": edges(n, 40),
         "others": torch.rand(n, 40) / 80}
        for n in (3, 0)
    )  # fmt: skip
    yield "proposal_excess", excess, "others", (usual, hard, none)


def _at_points() -> Iterator[Family]:
    """Encodings, contraction, and the optimiser of tables."""
    faces = torch.tensor([[a, b, 0.5] for a in PLACES for b in PLACES[:3]])
    unit = torch.nn.functional.normalize(torch.randn(300, 3), dim=-1)
    for kernel, run, entries, features in (
        ("hash_grid", lambda positions, table: (hash_grid(positions, table, GRID),), GRID.num_entries, 2),
        ("planes", lambda positions, table: (planes(positions, table, LAYOUT),), LAYOUT.num_entries, 6),
    ):
        table = torch.randn(entries, features)
        places = 1.2 * torch.rand(130, 3) - 0.1, faces, torch.rand(0, 3)
        usual, hard, none = ({"positions": positions, "table": table} for positions in places)
        yield kernel, run, "positions table", (usual, hard, none)

    def with_gradient(positions: Tensor, table: Tensor, first: Tensor, second: Tensor) -> Sequence[Tensor]:
        return (distance_network(positions, table, first, second, GRID),)

    usual, hard, none = (
        {"positions": positions, "table": torch.randn(GRID.num_entries, 2),
         "first": torch.randn(16, 2 * GRID.num_levels), "second": torch.randn(4, 16)}
        for positions in (1.2 * torch.rand(130, 3) - 0.1, faces, torch.rand(0, 3))
    )  # fmt: skip
    yield "distance_network", with_gradient, "table first second", (usual, hard, none)
    yield from _surfaces(unit)
    yield from _harmonics(unit)
    bits = (torch.randn(90, 3) * 256).round() / 256  # few bits, so that x times 2^k is the same angle in both types
    far = torch.tensor([[0.0, 8191, -100.5], [1e-30, 2.0**-20, 4096]])
    usual, hard, none = ({"x": rows} for rows in (bits, far, bits[:0]))
    yield "frequency_encoding", lambda x: (frequency_encoding(x, 6),), "x", (usual, hard, none)
    odd = [[0.0, -0.25, 0.5], [1, -0.25, 0.5], [1e13, 2e12, 0], [1e30, -1e30, 3], [3e38, 3e38, -3e38]]
    usual, hard, none = (
        {"x": rows, "box": BOX} for rows in (5 * torch.randn(300, 3), torch.tensor(odd), torch.rand(0, 3))
    )
    yield "contract_to_unit", lambda x, box: (contract_to_unit(x, box),), "x", (usual, hard, none)

    def updated(values: Tensor, grad: Tensor, mean: Tensor, square: Tensor, seen: Tensor) -> Sequence[Tensor]:
        sparse_adam(values, grad, mean, square, seen, 0.01, (0.9, 0.99), 1e-15)
        return values, grad, mean, square, seen

    def adam(entries: int) -> Inputs:
        given = {name: torch.rand(entries, 2) for name in ("values", "grad", "mean", "square")}
        given["grad"] = given["grad"] * (torch.rand(entries, 1) > 0.5)
        return {**given, "seen": torch.randint(0, 40, (entries,)).float()}

    hard = adam(5)
    hard["grad"] = torch.tensor([[1e-18, 0.0], [1e18, -1e18], [0, 0], [1, 2], [1, -0.0]])
    hard["mean"], hard["square"] = torch.zeros(5, 2), torch.zeros(5, 2)
    hard["seen"] = torch.tensor([0.0, 0, 3, 1e6, 5e3])
    yield "sparse_adam", updated, "", (adam(300), hard, adam(0))


def _harmonics(directions: Tensor) -> Iterator[Family]:
    """Harmonics, and their means over distributions of directions."""
    poles = torch.tensor([[0.0, 0, -1], [0, 0, 1], [1, 0, 0], [0, -1, 0]])
    places = directions, poles, poles[:0]
    usual, hard, none = ({"directions": rows} for rows in places)
    yield "spherical_harmonics", lambda directions: (spherical_harmonics(directions, 4),), "", (usual, hard, none)

    def blurred(directions: Tensor, roughness: Tensor) -> Sequence[Tensor]:
        return (directional_encoding(directions, roughness),)

    rough = torch.tensor([0.0, 1e-4, 10.0, 1e30])
    given = zip(places, (torch.rand(len(directions)), rough, rough[:0]), strict=True)
    usual, hard, none = ({"directions": rows, "roughness": each} for rows, each in given)
    yield "directional_encoding", blurred, "directions roughness", (usual, hard, none)


def _surfaces(directions: Tensor) -> Iterator[Family]:
    """Samples of a signed distance around a ball on a floor, and their normals."""

    def shape(like: Tensor) -> FirstShape:
        centre, scale = like.new_tensor([0.1, -0.2, 0.3]), like.new_tensor([0.5, 0.4, 0.6])
        return FirstShape(centre, scale, 1.0, 0.9, 1e-3, like.new_tensor([0.6, 0.0, 0.8, -0.5]))

    def both(
        network: Tensor, sharpness: Tensor, positions: Tensor, directions: Tensor, lengths: Tensor
    ) -> Sequence[Tensor]:
        given = network, sharpness, positions, shape(network)
        return *surface_samples(*given, Intervals(directions, lengths, 0.4)), surface_samples(*given)[0]

    count = len(directions)
    along = {"directions": directions.flip(0), "lengths": torch.rand(count)}
    usual = {
        "network": torch.randn(count, 8) / 4,
        "sharpness": torch.tensor(12.0),
        "positions": directions * 1.1,
    } | along
    hard = {"network": torch.zeros(count, 8), "sharpness": torch.tensor(1e4), "positions": directions * 1e4}
    hard |= {"directions": -directions, "lengths": torch.zeros(count)}
    none = {name: value[:0] if value.ndim else value for name, value in usual.items()}
    yield "surface_samples", both, "network sharpness", (usual, hard, none)
    rows = torch.randn(count, 7)
    lengths = torch.tensor([1e-30, 1e-6, 1.0, 1e6, 1e15]).repeat_interleave(count // 5)[:, None]
    usual, hard, none = ({"features": each} for each in (rows, rows[: len(lengths)] * lengths, rows[:0]))
    yield "unit_normals", lambda features: (unit_normals(features),), "features", (usual, hard, none)


def _grid(like: Tensor, full: bool = True) -> Occupancy:
    occupied = torch.full((CELLS**3,), full, device=like.device)
    return Occupancy(occupied, BOX.to(like), CELLS)


def _marched() -> Iterator[Family]:
    """Marches through a full grid, where only the last step depends on rounding, and the operations after them."""

    def rays(origins: Tensor, directions: Tensor) -> Rays:
        return Rays(origins, directions, torch.full_like(origins[:, 0], 0.1), torch.full_like(origins[:, 0], 20.0))

    def in_waves(origins: Tensor, directions: Tensor) -> Sequence[Tensor]:
        marched = march(rays(origins, directions), _grid(origins), STEP, 0.0, None, 0.0)
        counts, places = origins.new_zeros(len(origins)), origins.new_zeros(len(origins))
        while (wave := marched.wave(9)) is not None:
            counts.index_add_(0, wave.owners, torch.ones_like(wave.t_starts))
            places.index_add_(0, wave.owners, wave.t)
            marched.advance(torch.ones_like(wave.t_starts))
        return counts, places

    def in_slots(origins: Tensor, directions: Tensor) -> Sequence[Tensor]:
        if not len(origins):  # the sampler never calls it without rays
            return (origins,)
        grid = _grid(origins, full=bool((origins[:, 0] < 50).all()))
        found = fill(rays(origins, directions), grid, STEP, STEPS, None, (4096, 2048)).placed
        return found.slots.counts, found.t_starts, found.t_ends

    origins = torch.nn.functional.normalize(torch.randn(33, 3), dim=-1) * 4
    towards = torch.nn.functional.normalize(torch.rand(33, 3) * 2 - 1 - origins, dim=-1)
    axes = torch.cat([torch.eye(3), -torch.eye(3)])
    hard = {"origins": torch.cat([-3.1 * axes, axes / 10 + 0.013, 9 + axes]), "directions": axes.repeat(3, 1)}
    usual, none = ({"origins": origins[:n], "directions": towards[:n]} for n in (33, 0))
    yield "march", in_waves, "", (usual, hard, none)
    nowhere = {"origins": origins + 99, "directions": towards}
    yield "fill_march", in_slots, "", (usual, hard, nowhere)

    def reached(sigma: Tensor, starts: Tensor, ends: Tensor, counts: Tensor) -> Sequence[Tensor]:
        slots = share_out(counts.long(), len(sigma))
        placed = Placed.of(starts, ends, slots.counts.cumsum(0) - slots.counts, slots)
        return (reach(placed, sigma, 1e-2, STEPS),)

    ends = torch.rand(700).cumsum(0) / 50
    given = {"sigma": 100 * torch.rand(700), "starts": ends - 0.02, "ends": ends}
    counts = torch.randint(0, 20, (33,)).float()
    light = {**given, "sigma": torch.where(torch.rand(700) < 0.3, math.inf, 0.0), "counts": counts}
    yield "reach", reached, "", ({**given, "counts": counts}, light, {**given, "counts": torch.zeros(33)})

    def sorted_(owners: Tensor, light: Tensor) -> Sequence[Tensor]:
        return sort_by_ray(owners.long(), light.to(torch.uint8), 7)

    usual, hard, none = (
        {"owners": torch.randint(7, (n,)).float(), "light": (torch.rand(n) < share).float()}
        for n, share in ((50, 0.5), (50, 0.0), (0, 0.0))
    )
    yield "sort_by_ray", sorted_, "", (usual, hard, none)


def _projected() -> Iterator[Family]:
    """Projection of Gaussians."""
    names = "means log_scales rotations logits colors harmonics pose"

    def gaussians(count: int) -> Inputs:
        pose = torch.cat([torch.eye(3), torch.tensor([[0.1], [-0.2], [4.0]])], 1)
        rows = torch.randn(count, 3), torch.randn(count, 3) / 2 - 1.5, torch.randn(count, 4), torch.randn(count) + 1
        values = (*rows, torch.randn(count, 3), torch.rand(count, 3, 8) / 3, pose)
        return dict(zip(names.split(), values, strict=True))

    def projected(pose: Tensor, **rows: Tensor) -> Sequence[Tensor]:
        camera = SplatCamera(pose, (30.0, 32.0, 20.0, 15.0), WIDTH, HEIGHT)
        records = project_gaussians(**rows, camera=camera, degree=2)[0]
        return records[:, : Record.CUT], records[:, BOUNDS].detach(), records[:, Record.RED : Record.NORMAL_X]

    hard = gaussians(12)
    hard["means"][0], hard["means"][1] = torch.tensor([0.0, 0, -9]), torch.tensor([90.0, 0, 1])
    hard["log_scales"][2], hard["log_scales"][3] = -30.0, 3.0
    hard["logits"][4], hard["logits"][5], hard["logits"][6] = -100.0, 100.0, math.inf
    hard["rotations"][8], hard["rotations"][10] = 0.0, hard["rotations"][10] * 1e-6
    yield "project_gaussians", projected, names, (gaussians(60), hard, gaussians(0))


def _on_images() -> Iterator[Family]:
    """Gaussians on the image, and the loss of pictures."""

    def records(count: int) -> Tensor:
        """Gaussians on the image, each with a circle of radius 4 around it."""
        found = torch.zeros(count, RECORD)
        found[:, :2] = torch.rand(count, 2) * torch.tensor([WIDTH, HEIGHT])
        found[:, WIDTHS], found[:, Record.OPACITY] = 0.3, 0.1 + 0.8 * torch.rand(count)
        found[:, Record.CUT], found[:, REACHES] = (found[:, Record.OPACITY] * 255).log(), 6.0
        found[:, Record.RED : Record.DISTANCE] = torch.rand(count, 3)
        found[:, Record.DISTANCE] = torch.rand(count) + 1
        return found

    def listed(records: Tensor) -> Sequence[Tensor]:
        """Return which Gaussian is in the list of the tile with its centre, and its order there."""
        lists: TileLists = tile_lists(records, WIDTH, HEIGHT)
        sizes, last = lists.offsets.diff().long(), len(lists.ids)
        tiles = torch.repeat_interleave(sizes, output_size=last)
        near = records[:, Record.DISTANCE].index_select(0, lists.ids.long()).float()
        sorted_ = (near.diff() >= 0) | (tiles.diff() > 0)
        own = records[:, 0].div(16).floor().long() + 3 * records[:, 1].div(16).floor().long()
        there = torch.zeros(len(sizes), len(records), device=records.device)
        there[tiles, lists.ids.long()] = 1.0
        return sorted_.all().float(), there.gather(0, own.clamp(0, len(sizes) - 1)[None])

    walls = records(30)
    walls[:, :2], walls[:, WIDTHS], walls[:, Record.DISTANCE] = torch.tensor([8.5, 7.5]), 0.05, 1.0
    walls[:, Record.OPACITY] = torch.tensor([0.004, 0.9, 1.0, 0.5, 0.99, 0.3] * 5)
    walls[:, Record.CUT], walls[:, REACHES] = (walls[:, Record.OPACITY] * 255).log(), 40.0
    usual, hard, none = ({"records": rows} for rows in (records(50), walls, records(0)))
    yield "tile_lists", listed, "", (usual, hard, none)

    def blended(records: Tensor, background: Tensor) -> Sequence[Tensor]:
        lists = tile_lists_reference(records, WIDTH, HEIGHT)
        records = torch.cat([records[:, : Record.CUT], records[:, BOUNDS].detach(), records[:, Record.RED :]], 1)
        return blend(records, lists, WIDTH, HEIGHT, background, 4, False)[:2]

    usual, hard, none = ({**each, "background": torch.tensor([0.2, 0.5, 1.0])} for each in (usual, hard, none))
    yield "blend", blended, "records", (usual, hard, none)

    def photometric(image: Tensor, target: Tensor) -> Sequence[Tensor]:
        return (photometric_loss(image, target, 0.2),)

    usual, hard, none = (
        {"image": factor * torch.rand(size, size, 3), "target": -(factor - 1) / 99 * torch.rand(size, size, 3) + other}
        for size, factor, other in ((17, 1.0, 0.3), (13, 100.0, 0.0), (11, 0.0, 0.0))
    )
    yield "photometric", photometric, "image", (usual, hard, none)

"""Terms of methods that learn a signed distance."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from nerfloom.data.pixels.batch import PixelBatch
from nerfloom.fields.surface import SurfaceField
from nerfloom.geometry.bounds import intersect_box
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.math import safe_normalize
from nerfloom.losses.functions import mean_squared_error
from nerfloom.losses.term import LossTerm, RenderedBatch
from nerfloom.renderable import parts
from nerfloom.samplers.cells import places
from nerfloom.samplers.occupancy import OccupancySampler
from nerfloom.scene.hidden_cells import HiddenCells

if TYPE_CHECKING:
    from nerfloom.ray_model import RayModel

EVERY, ANYWHERE, BENT = 8, 16, 32
"""`Eikonal` uses one in `EVERY` samples, so that others may be without a gradient and are skipped. For each `ANYWHERE`
samples it adds a random position in the box. `Curvature` uses one in `BENT` samples."""

SMALLEST_CHANGE = 1e-3
"""Difference of normals below which the curvature term is quadratic."""

TRIED = 1024
"""Number of random positions in the box for `HiddenSpace`."""
SMOOTH_UNTIL = 0.4
"""Fraction of the training budget with the curvature term. Later it removes details (docs/notes/surfaces.md)."""
BEHIND = 0.03
"""Thickness of space behind points of a reconstruction that counts as solid, in halves of the box's shortest edge."""


class Eikonal(LossTerm):
    """Squared difference of the distance's gradient from length 1: Gropp et al. 2020, equation 2.

    It is computed at some of the samples and at random positions in the box.
    """

    def __init__(self) -> None:
        super().__init__("eikonal", "eikonal_loss_mult")

    def __call__(self, shown: RenderedBatch) -> Tensor | None:
        samples, field = shown.rendered.samples, shown.model.field
        if samples is None or samples.features is None or not len(samples):
            return None
        assert isinstance(field, SurfaceField)
        elsewhere = field.shape(random_positions(max(len(samples) // ANYWHERE, 1), field, shown.model)).gradients
        some = some_of(len(samples))
        gradients = torch.cat([samples.features[some, :3], elsewhere])
        counted = torch.cat([samples.deltas[some] > 0, torch.ones_like(elsewhere[:, 0], dtype=torch.bool)])
        return mean_of((gradients.norm(dim=-1) - 1).square(), counted)


def random_positions(count: int, field: SurfaceField, model: RayModel[Any]) -> Tensor:
    """Return random positions in the box, in cells that silhouettes do not show to be empty.

    Args:
        count: number of positions.
        field: its box.
        model: its occupancy grid has the cells.

    Returns:
        (count, 3).
    """
    grids = parts(model, OccupancySampler)
    kept = grids[0].kept()[1] if grids else None
    unit = torch.rand(count, 3, device=field.box.device)
    if kept is not None:
        cells = kept[torch.randint(len(kept), (count,), device=kept.device)].long()
        unit = (places(cells, grids[0].resolution)[:, 1:] + unit) / grids[0].resolution
    low, high = field.box
    return torch.lerp(low, high, unit)


class Silhouette(LossTerm):
    """Difference between the opacity of pixels and the alpha of their images: the mask of IDR (Yariv et al. 2020)."""

    def __init__(self) -> None:
        super().__init__("silhouette", "silhouette_loss_mult")

    def applies(self, batch: PixelBatch, model: RayModel[Any]) -> bool:
        return batch.alpha is not None

    def __call__(self, shown: RenderedBatch) -> Tensor | None:
        batch = shown.batch
        assert batch.alpha is not None
        return mean_squared_error(shown.pixels.accumulation[:, None], batch.alpha[:, None], batch.weights)


class Curvature(LossTerm):
    """Change of normals along the surface: PermutoSDF (Rosu and Behnke 2023).

    Some samples are compared with a position one sample's length away, in a random direction along the level set. The
    term is the mean difference of the two unit normals, so that edges count less than noise everywhere. It applies
    during the first part `SMOOTH_UNTIL` of the training budget.
    """

    def __init__(self) -> None:
        super().__init__("curvature", "curvature_loss_mult")

    def __call__(self, shown: RenderedBatch) -> Tensor | None:
        samples, field = shown.rendered.samples, shown.model.field
        assert isinstance(field, SurfaceField)
        if field.progress > SMOOTH_UNTIL or samples is None or samples.features is None or not len(samples):
            return None
        some = some_of(len(samples), BENT)
        normals = safe_normalize(samples.features[some, :3])
        positions, lengths = samples.positions(shown.batch.rays)[some], samples.deltas[some]
        moved = positions + lengths[:, None] * tangents(normals.detach())
        return mean_of(normal_change(normals, safe_normalize(field.shape(moved).gradients)), lengths > 0)


def mean_of(values: Tensor, counted: Tensor) -> Tensor:
    """Return the mean () of the values that count. Slots without a sample, as on a GPU, do not.

    Args:
        values: (N,).
        counted: (N,) bool; if all are False, the mean is 0.
    """
    return torch.where(counted, values, 0).sum() / counted.sum().clamp(min=1)


def some_of(count: int, every: int = EVERY) -> slice:
    """Return one in `every` of `count` samples, from a random one on; at least one sample.

    Args:
        count: number of samples, at least 1.
    """
    return slice(int(torch.randint(min(every, count), ())), None, every)


def tangents(normals: Tensor) -> Tensor:
    """Return random unit directions (N, 3) perpendicular to unit vectors.

    Args:
        normals: (N, 3).
    """
    return safe_normalize(torch.linalg.cross(normals, torch.randn_like(normals)))


def normal_change(normals: Tensor, others: Tensor) -> Tensor:
    """Return the difference (N,) of unit normals; for an angle a between them it is 2 sin(a / 2).

    Args:
        normals, others: (N, 3).
    """
    return ((normals - others).square().sum(-1) + SMALLEST_CHANGE**2).sqrt()


class HiddenSpace(LossTerm):
    """Positive distances in hidden space (`HiddenCells`), which stays solid: nothing else determines its distances.

    Without the term, hollows appear below a floor and inside of things, and meshes have their walls. The term is the
    mean of max(f, 0) over random positions in the box, in halves of its shortest edge. It is 0 outside of hidden and
    occupied cells.
    """

    def __init__(self) -> None:
        super().__init__("hidden", "hidden_loss_mult")

    def applies(self, batch: PixelBatch, model: RayModel[Any]) -> bool:
        return bool(parts(model, HiddenCells))

    def __call__(self, shown: RenderedBatch) -> Tensor | None:
        field, model = shown.model.field, shown.model
        assert isinstance(field, SurfaceField)
        hidden, grid = parts(model, HiddenCells)[0], parts(model, OccupancySampler)[0]
        low, high = field.box
        places = torch.lerp(low, high, torch.rand(TRIED, 3, device=low.device))
        behind = hidden.at(places) & grid.occupied.index_select(0, grid.occupancy.cells(places))
        return torch.where(behind, torch.relu(field.shape(places).distances), 0).mean() / field.size


class KnownPoints(NamedTuple):
    """Points of a reconstruction inside the box of a field, as seen in K pixels."""

    rays: Rays
    """The rays of the pixels."""
    entries: Tensor
    """(K,) distance where they enter the box."""
    distances: Tensor
    """(K,) distance to the point."""
    deviations: Tensor
    """(K,) its standard deviation."""

    def places(self, t: Tensor) -> Tensor:
        """Return the positions (..., K, 3) at distances `t` (..., K) along the rays."""
        return torch.addcmul(self.rays.origins, self.rays.directions, t[..., None])


def known_points(batch: PixelBatch, box: Tensor) -> KnownPoints:
    """Return the points that a batch's pixels show inside a box.

    Args:
        batch: pixels, with distances and their deviations.
        box: (2, 3) corners.
    """
    assert batch.distances is not None
    assert batch.deviations is not None
    rays = batch.rays[:: batch.rays_per_pixel]
    enter, leave = intersect_box(rays.origins, rays.directions, box)
    inside = (batch.distances > enter) & (batch.distances < leave)
    return KnownPoints(rays[inside], enter[inside], batch.distances[inside], batch.deviations[inside])


class PointsTerm(LossTerm):
    """A mean error of distances by points of a reconstruction, in halves of the box's shortest edge."""

    def applies(self, batch: PixelBatch, model: RayModel[Any]) -> bool:
        return batch.deviations is not None

    def __call__(self, shown: RenderedBatch) -> Tensor | None:
        field = shown.model.field
        assert isinstance(field, SurfaceField)
        known = known_points(shown.batch, field.box)
        return self.errors(field, known).mean() / field.size if len(known.distances) else None

    @abstractmethod
    def errors(self, field: SurfaceField, known: KnownPoints) -> Tensor:
        """Return errors of `field` by K `known` points, K > 0, scene units, in any shape."""


class SurfacePoints(PointsTerm):
    """Distance at points of a reconstruction, which lie on surfaces: Geo-NeuS (Fu et al. 2022).

    The error is the excess of |f| over the point's standard deviation.
    """

    def __init__(self) -> None:
        super().__init__("points", "points_loss_mult")

    def errors(self, field: SurfaceField, known: KnownPoints) -> Tensor:
        found = field.shape(known.places(known.distances)).distances
        return torch.relu(found.abs() - known.deviations)


class DistanceBounds(PointsTerm):
    """Bounds of the distance at random positions before and behind points of a reconstruction, on rays that see them.

    If an image shows a point, space in front of the point is empty: the signed distance there is positive, and at most
    the distance to the point. Space just behind the point counts as solid: the signed distance there is negative, and
    its magnitude is at most the distance to the point. The error is the excess over these bounds.
    """

    def __init__(self) -> None:
        super().__init__("bounds", "bounds_loss_mult")

    def errors(self, field: SurfaceField, known: KnownPoints) -> Tensor:
        before = (known.distances - known.entries) * torch.rand_like(known.distances)
        behind = -BEHIND * field.size * torch.rand_like(known.distances)
        left = torch.stack([before, behind])
        found = field.shape(known.places(known.distances - left).flatten(0, 1)).distances.view_as(left)
        return beyond_bounds(found, left, known.deviations)


def beyond_bounds(distances: Tensor, left: Tensor, deviations: Tensor) -> Tensor:
    """Return how far distances are outside the interval from 0 to the remaining length to a point.

    Args:
        distances: signed distances of any shape, scene units.
        left: remaining lengths to a point on a surface, of the same shape; negative behind the point.
        deviations: standard deviations of these lengths, broadcast to that shape; deviations up to this are allowed.
    """
    low, high = left.clamp(max=0) - deviations, left.clamp(min=0) + deviations
    return torch.relu(distances - high) + torch.relu(low - distances)

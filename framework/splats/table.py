"""Gaussians as a table for the optimiser: a named column for each parameter, and a row for each Gaussian."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TypeAlias

import torch
from torch import Tensor, nn

from nerfloom.base.optimised import Optimised, RowChange
from nerfloom.kernels.adam.row_gradient import RowGradient, table_rows
from nerfloom.kernels.table_memory import IN_MEMORY, Tables
from nerfloom.splats.gaussians import Gaussians


class Column(nn.Module):
    """One parameter of every Gaussian, with its optimiser settings.

    Args:
        shape: shape of one Gaussian's values.
        optimised: optimiser settings.
        in_extents: whether the values are lengths, stored in units of the scene's extent. One learning rate then suits
            scenes of any size.
    """

    def __init__(self, shape: tuple[int, ...], optimised: Optimised, in_extents: bool = False) -> None:
        super().__init__()
        self.shape, self.in_extents = shape, in_extents
        self.values = nn.Parameter(torch.zeros(0, math.prod(shape)))
        self.optimised = optimised
        self.tables = IN_MEMORY
        self.deferred: RowGradient | None = None

    @property
    def table(self) -> nn.Parameter:
        """The values, (N, width): the table of `deferred`."""
        return self.values

    def keep_in(self, tables: Tables) -> None:
        """Keep the values in `tables`, where a step reads and changes only the rows that it uses."""
        self.tables = tables
        self.deferred = RowGradient() if self.values.shape[1] else None
        self.set(self.values.data)

    def set(self, values: Tensor) -> None:
        """Replace the values by `values` (N, width), contiguous, lengths in extents of the scene if `in_extents`."""
        self.values.data = self.tables.kept(values)

    def read(self, extent: Tensor | float, rows: Tensor | None = None) -> Tensor:
        """Return the values (N, *shape), lengths in scene units.

        Args:
            extent: size of the scene, scene units.
            rows: (K,) int64 the Gaussians to read, each at most once; None for all N.
        """
        values = self.values if rows is None else table_rows(self.values, rows, self.deferred)
        values = values.view(len(values), *self.shape)
        return values * extent if self.in_extents else values

    def rows(self, values: Tensor, extent: Tensor | float) -> Tensor:
        """Return rows (N, width) as they are stored: the inverse of `read`.

        Args:
            values: (N, *shape), lengths in scene units.
            extent: size of the scene, scene units.
        """
        rows = values.reshape(len(values), self.values.shape[1])
        return rows / extent if self.in_extents else rows

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: object) -> None:
        saved = state_dict.get(name := prefix + "values")
        if saved is not None and saved.ndim == 2 and saved.shape[1] == self.values.shape[1]:
            self.values.data = self.tables.copied(saved, self.values)
            state_dict = {**state_dict, name: self.values.detach()}
        super()._load_from_state_dict(state_dict, prefix, *rest)
        self.tables.release()


Columns: TypeAlias = Mapping[str, Column]


def usual_columns(degree: int, rate: float, position_rate: float) -> dict[str, Column]:
    """Return the columns of 3D Gaussian Splatting, by the names that `Gaussians` has for them.

    Args:
        degree: highest degree of the harmonics.
        rate: learning rate of scales; the others have a fixed ratio to it.
        position_rate: learning rate of centres, extents of the scene. Only this rate follows the run's schedule; the
            others fall to the same share of themselves in the last 15 % of the budget. Each step shows one image, and
            small steps at the end average over several.
    """

    def column(shape: tuple[int, ...], name: str, factor: float) -> Column:
        return Column(shape, Optimised(name, factor * rate, schedule="fall-late", sparse=True))

    return {
        "means": Column((3,), Optimised("means", position_rate, sparse=True), in_extents=True),
        "log_scales": column((3,), "scales", 1.0),
        "rotations": column((4,), "rotations", 0.2),
        "logits": column((), "opacities", 10.0),
        "colors": column((3,), "colors", 0.5),
        "harmonics": column((3, (degree + 1) ** 2 - 1), "harmonics", 0.025),
    }


def as_gaussians(columns: Columns, extent: Tensor | float = 1.0, rows: Tensor | None = None) -> Gaussians:
    """Return the Gaussians with their parameters in columns.

    Args:
        columns: N rows of each column, by name.
        extent: size of the scene, scene units.
        rows: (K,) int64 the Gaussians to return, each at most once; None for all N.
    """
    return Gaussians.of({name: column.read(extent, rows) for name, column in columns.items()})


def as_rows(columns: Columns, gaussians: Gaussians, extent: Tensor | float = 1.0) -> dict[str, Tensor]:
    """Return the parameters of N Gaussians as rows of columns: the inverse of `as_gaussians`.

    Args:
        gaussians: N Gaussians. A column that they lack is 0.
        extent: size of the scene, scene units.

    Raises:
        ValueError: if they have a column that is not among `columns`.
    """
    given = gaussians.columns
    if unknown := given.keys() - columns.keys():
        raise ValueError(f"there is no column {', '.join(sorted(unknown))}, only {', '.join(columns)}")

    def zeros(column: Column) -> Tensor:
        return gaussians.log_scales.new_zeros(len(gaussians), *column.shape)

    return {name: column.rows(given.get(name, zeros(column)), extent) for name, column in columns.items()}


def row_changes(
    columns: Columns, kept: Tensor, fresh: Gaussians, extent: Tensor | float = 1.0, order: Tensor | None = None
) -> list[RowChange]:
    """Return the changes of columns that keep some Gaussians and add others.

    Args:
        kept: (K,) int64 indices of the Gaussians that stay.
        fresh: the A new Gaussians.
        extent: size of the scene, scene units.
        order: (K + A,) int64 order of the Gaussians that stay and then the new ones; None for this order.
    """
    rows = as_rows(columns, fresh, extent)
    return [RowChange(column.values, kept, rows[name], order) for name, column in columns.items()]

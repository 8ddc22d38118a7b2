"""Records of tensors: frozen dataclasses with tensors that are changed, moved or selected together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

RecordT = TypeVar("RecordT", bound="TensorRecord")
RowsT = TypeVar("RowsT", bound="TensorRows")


@dataclass(frozen=True)
class TensorRecord:
    """A frozen dataclass with tensors among its fields."""

    def map(self: RecordT, change: Callable[[Tensor], Tensor]) -> RecordT:
        """Return the record with a function applied to every tensor.

        Args:
            change: the function.
        """
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        changed: dict[str, Any] = {name: change(value) for name, value in values.items() if isinstance(value, Tensor)}
        return replace(self, **changed)

    def to(self: RecordT, device: torch.device | str) -> RecordT:
        """Return the record on `device`."""
        return self.map(lambda values: values.to(device))


@dataclass(frozen=True)
class TensorRows(TensorRecord):
    """A record of items: every tensor has one row for each."""

    def __getitem__(self: RowsT, index: Tensor | slice) -> RowsT:
        """Return the items selected by a slice, a mask or an index tensor."""
        return self.map(lambda values: values[index])

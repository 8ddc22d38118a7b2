"""A device in the place of a GPU: torch's "meta", with values behind its tensors, which the CPU computes.

As on a GPU, an operation takes tensors of one device: tensors of the CPU are refused beside them, except numbers and
indices. Functions of CUDA alone (streams, graphs, its kernels) are not imitated.
"""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map, tree_unflatten

from benchmarks.operations import _place, _waits

OTHER = torch.device("meta", 1)
"""Not "meta" itself: caches by device would reach tests on that device, which has tensors without values."""
BRING = {"aten::copy_", "aten::_to_copy"}
"""Operations that take tensors of both devices."""
INDEX = {"aten::index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_"}
"""Operations with indices that may be on the CPU."""


class There(Tensor):
    """A tensor of the other device."""

    values: Tensor
    """Its values, on the CPU."""

    @staticmethod
    def __new__(cls, values: Tensor) -> "There":
        found = Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
            cls,
            values.shape,
            strides=values.stride(),
            storage_offset=values.storage_offset(),
            dtype=values.dtype,
            device=OTHER,
        )
        found.values = values
        return found

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return computed(func, args, kwargs or {})

    @property
    def data(self) -> Tensor:
        return Tensor.data.__get__(self)  # type: ignore[attr-defined]

    @data.setter
    def data(self, other: "There") -> None:
        Tensor.data.__set__(self, other)  # type: ignore[attr-defined]
        self.values = other.values

    def data_ptr(self) -> int:
        return self.values.data_ptr()

    def tolist(self) -> Any:
        return self.cpu().tolist()

    def numpy(self, **settings: Any) -> Any:
        raise TypeError("this tensor is on another device: use Tensor.cpu() first")


def computed(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Compute an operation of torch's, on whichever device its tensors are.

    Raises:
        RuntimeError: if they are on both.
    """
    name = func.name().split(".")[0]
    device = kwargs.get("device")
    flat, shape = tree_flatten((args, kwargs))
    there = [each for each in flat if isinstance(each, There)]
    if there and name not in BRING:
        taken = (args[0], *args[2:3]) if name in INDEX else flat
        here = [each for each in taken if isinstance(each, Tensor) and not isinstance(each, There) and each.ndim]
        if here:
            raise RuntimeError(f"{func}: tensors are on two devices, as {tuple(here[0].shape)} is on the CPU")
    if device is not None:
        to_there = torch.device(device).type == OTHER.type
    else:
        to_there = isinstance(args[0], There) if name == "aten::copy_" else bool(there)
    wrapped = {id(each.values): each for each in there}
    args, kwargs = tree_unflatten([each.values if isinstance(each, There) else each for each in flat], shape)
    if device is not None:
        kwargs["device"] = torch.device("cpu")
    out = func(*args, **kwargs)
    if there and not to_there and isinstance(out, Tensor) and out is there[0].values:
        return out.clone()
    if not to_there:
        return out

    def wrap(value: Any) -> Any:
        if not isinstance(value, Tensor):
            return value
        return wrapped[id(value)] if id(value) in wrapped else There(value)

    return tree_map(wrap, out)


class OtherDevice(TorchDispatchMode):
    """Computes operations of the other device, and counts Python's waits by place."""

    def __init__(self) -> None:
        super().__init__()
        self.waits = Counter[str]()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if any(isinstance(each, There) for each in tree_flatten((args, kwargs))[0]) and _asks(func, args, kwargs):
            self.waits[str(_place())] += 1
        return computed(func, args, kwargs)


def _asks(func: Any, args: Any, kwargs: dict[str, Any]) -> bool:
    """Return whether Python waits for the result of an operation on the other device."""
    if func.name().startswith("aten::_to_copy"):
        return kwargs.get("device") is not None and torch.device(kwargs["device"]).type != OTHER.type
    return _waits(func, args, kwargs)


@contextmanager
def other_device() -> Iterator[OtherDevice]:
    """The other device, within the block."""
    make, make_like = torch.tensor, torch.as_tensor

    def tensor(data: Any, *, dtype: Any = None, device: Any = None, requires_grad: bool = False) -> Tensor:
        found = make(data, dtype=dtype)
        return (found if device is None else found.to(device)).requires_grad_(requires_grad)

    def as_tensor(data: Any, dtype: Any = None, device: Any = None) -> Tensor:
        found = data if isinstance(data, Tensor) else make_like(data, dtype=dtype)
        return found.to(device=found.device if device is None else device, dtype=dtype or found.dtype)

    def new_tensor(self: Tensor, data: Any, *, dtype: Any = None, device: Any = None) -> Tensor:
        return tensor(data, dtype=dtype or self.dtype, device=device or self.device)

    with (
        patch.object(torch, "tensor", tensor),  # which torch itself makes on "meta" without values
        patch.object(torch, "as_tensor", as_tensor),
        patch.object(Tensor, "new_tensor", new_tensor),
        patch.object(torch, "autocast", lambda *words, **settings: nullcontext()),  # which "meta" does not have
        OtherDevice() as mode,
    ):
        yield mode

"""A module's protocols are recognised from its registered attributes, on every Python."""

import importlib
import inspect
import pkgutil
from typing import Any, Protocol, runtime_checkable

import pytest
import torch
from torch import nn

import nerfloom
from nerfloom.base.optimised import DefersGradient
from nerfloom.base.protocols import SeesRegistered
from nerfloom.cameras.refinement import PoseRefinement
from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.renderable import RefinesPoses
from nerfloom.samplers.base import Carved, SkipsCells, StopsEarly
from nerfloom.samplers.occupancy import OccupancySampler

CUBE = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])
WITH_ATTRIBUTES = (Carved, SkipsCells, StopsEarly, RefinesPoses, DefersGradient)


class WithPoses(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.poses = PoseRefinement(4, "SE3", torch.eye(3, 4).repeat(4, 1, 1))


def members(kind: Any) -> set[str]:
    """The members that Python 3.12 and newer look for."""
    annotated = {name for base in kind.__mro__ for name in inspect.get_annotations(base)}
    return annotated | {name for name, value in vars(kind).items() if callable(value) and not name.startswith("_")}


@pytest.fixture(params=["as this Python asks", "as Python 3.12 and newer ask"])
def asked(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param.endswith("ask"):
        for kind in WITH_ATTRIBUTES:
            monkeypatch.setattr(kind, "__protocol_attrs__", members(kind), raising=False)


@pytest.mark.usefixtures("asked")
def test_buffers_parameters_and_parts_are_seen() -> None:
    grid = OccupancySampler(CUBE, resolution=4)
    assert isinstance(grid, SkipsCells)
    assert isinstance(grid, Carved)
    assert isinstance(grid, StopsEarly)
    assert isinstance(WithPoses(), RefinesPoses)
    assert isinstance(HashGrid(num_levels=2, log2_table_size=8), DefersGradient)


@pytest.mark.usefixtures("asked")
def test_what_lacks_one_is_none_of_the_kind() -> None:
    assert not isinstance(nn.Linear(2, 2), SkipsCells)
    assert not isinstance(nn.Linear(2, 2), RefinesPoses)
    grid = OccupancySampler(CUBE, resolution=4)
    del grid.carved
    assert not isinstance(grid, SkipsCells)
    assert isinstance(grid, StopsEarly)


@pytest.mark.medium
def test_every_protocol_with_attributes_sees_what_is_registered() -> None:
    """A new one that does not would be blind from Python 3.12 on."""
    kinds = {}
    for module in pkgutil.walk_packages(nerfloom.__path__, "nerfloom."):
        named = module.name
        if ".templates" in named or ".integrations" in named or named.endswith(("_triton", "triton_launch")):
            continue
        for value in vars(importlib.import_module(module.name)).values():
            if getattr(value, "_is_runtime_protocol", False) and str(value.__module__).startswith("nerfloom."):
                kinds[value.__qualname__] = value
    annotated = {name for name, kind in kinds.items() if any(map(inspect.get_annotations, kind.__mro__))}
    assert annotated == {kind.__qualname__ for kind in WITH_ATTRIBUTES}
    assert all(isinstance(kinds[name], SeesRegistered) for name in annotated)


def test_a_class_that_derives_from_a_protocol_is_told_as_any_other() -> None:
    @runtime_checkable
    class Named(Protocol, metaclass=SeesRegistered):
        name: str

    class Derived(Named):
        pass

    assert isinstance(Derived(), Derived)
    assert not isinstance(nn.Linear(2, 2), Derived)

"""`import nerfloom` costs nothing, and everything in it has a docstring."""

import inspect
import subprocess
import sys

import pytest

import nerfloom


def test_the_import_loads_neither_torch_nor_methods() -> None:
    heavy = ("nerfloom", "torch", "numpy", "nerfloom.methods", "nerfloom.model")
    code = f"import sys, nerfloom; print(*(name for name in {heavy} if name in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["nerfloom"]


def test_a_name_is_what_the_file_that_defines_it_has() -> None:
    from nerfloom.geometry.rays import Rays

    assert nerfloom.Rays is Rays


def test_every_name_is_found_and_documented() -> None:
    assert {"OccupancyGrid", "sample", "render", "Rays", "Samples"} <= set(nerfloom.__all__)
    for name in nerfloom.__all__:
        thing = getattr(nerfloom, name)
        assert thing.__name__ == name
        assert name in dir(nerfloom)
        assert inspect.getdoc(thing), name
        members = vars(thing).items() if inspect.isclass(thing) else ()
        for member, value in members:
            if not member.startswith("_") and (inspect.isfunction(value) or isinstance(value, property)):
                assert inspect.getdoc(value), f"{name}.{member}"


def test_type_checkers_see_the_same_names() -> None:
    """The names under TYPE_CHECKING equal the table of `__getattr__`."""
    source = inspect.getsource(nerfloom)
    for name, home in nerfloom._HOMES.items():
        assert f"    from nerfloom.{home} import {name} as {name}\n" in source


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(AttributeError, match="module 'nerfloom' has no attribute 'Nonsense'"):
        _ = nerfloom.Nonsense

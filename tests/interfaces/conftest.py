"""Plugins of the tests, registered as a shell would."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from nerfloom import registry

METHODS = {
    "fog": "plugins.fog",
    "even": "plugins.even",
    "vertices": "plugins.vertices",
    "discs": "methods.discs",
    "cones": "methods.cones",
    "surface": "methods.surface",
    "doubtful": "methods.doubtful",
    "fittest": "methods.fittest",
    "drift": "methods.drift",
}
HERE = Path(__file__).parent


def sources() -> list[Path]:
    """Return the plugins' files."""
    return [path for folder in ("plugins", "methods") for path in sorted((HERE / folder).glob("[a-z]*.py"))]


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let commands find the plugins by name."""
    methods = ",".join(f"{name}=tests.interfaces.{module}:METHOD" for name, module in METHODS.items())
    monkeypatch.setenv("NERFLOOM_METHODS", methods)
    monkeypatch.setenv("NERFLOOM_DATAPARSERS", "ring=tests.interfaces.plugins.ring:Ring")
    registry.registered.cache_clear()
    yield
    registry.registered.cache_clear()

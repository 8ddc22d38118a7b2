"""Names of methods and formats: lazy, and honest about what is broken."""

import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from framework import registry
from framework.errors import ConfigError, DataError

BUILT_IN = {"dnerf", "instant-ngp", "kplanes", "tensorf", "vanilla-nerf"}


def test_the_built_in_methods_are_registered_like_anybodys() -> None:
    assert set(registry.registered("methods")) >= BUILT_IN
    assert set(registry.registered("dataparsers")) >= {"blender", "dnerf", "procedural"}
    for name in BUILT_IN:
        assert registry.load_method(name).paper.startswith("arXiv:")


def test_summaries_are_the_modules_first_lines() -> None:
    import methods.instant_ngp

    assert methods.instant_ngp.__doc__ is not None
    entry = registry.registered("methods")["instant-ngp"]
    assert registry.summary(entry) == methods.instant_ngp.__doc__.split("\n")[0]


def test_listing_imports_neither_torch_nor_methods() -> None:
    code = (
        "import sys; from framework.cli.train import _overview; text = _overview(); "
        "assert 'instant-ngp' in text; print([m for m in ('torch', 'numpy', 'tyro', 'methods') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_unknown_names_get_the_nearest() -> None:
    with pytest.raises(ConfigError, match=r"unknown method 'instant-npg'\. Did you mean 'instant-ngp'"):
        registry.load_method("instant-npg")
    with pytest.raises(ConfigError, match=r"unknown data format 'xyz'\. Known: blender"):
        registry.load_dataparser("xyz")


def entry(name: str, value: str) -> EntryPoint:
    return EntryPoint(name, value, "nerfloom.methods")


def test_a_broken_plugin_is_named_and_the_rest_goes_on(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "broken_plugin.py").write_text('"""Never loads."""\nraise RuntimeError("no such luck")\n')
    monkeypatch.syspath_prepend(str(tmp_path))
    known = {**registry.registered("methods"), "broken": entry("broken", "broken_plugin:METHOD")}
    monkeypatch.setattr(registry, "registered", lambda kind: known)
    assert registry.summary(known["broken"]) == "Never loads."
    with pytest.raises(ConfigError, match="'broken' of package broken_plugin cannot be loaded: RuntimeError: no such"):
        registry.load_method("broken")
    assert registry.load_method("instant-ngp").paper
    assert registry.summary(entry("gone", "no_such_module_at_all:X")) == "(its module was not found)"


def test_two_packages_with_one_name_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "entry_points", lambda group: [entry("a", "one:X"), entry("a", "two:X")])
    registry.registered.cache_clear()
    try:
        with pytest.raises(ConfigError, match="'a' is registered by both one:X and two:X"):
            registry.registered("methods")
    finally:
        registry.registered.cache_clear()


def test_recognition(shared_tiny: Path, tmp_path: Path) -> None:
    assert registry.recognize(shared_tiny) == "blender"
    assert registry.recognize(None) == "procedural"
    with pytest.raises(DataError, match="there is no such folder"):
        registry.recognize(tmp_path / "nowhere")
    with pytest.raises(DataError, match="no known data format"):
        registry.recognize(tmp_path)

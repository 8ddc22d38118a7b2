"""The registry of methods and data formats by name. A module is imported only when it is loaded by name.

Built-in and third-party packages register their entries in the same way, with entry points:

    [project.entry-points."nerfloom.methods"]
    my-method = "my_package.my_method:METHOD"      # a nerfloom.Method

    [project.entry-points."nerfloom.dataparsers"]
    my-format = "my_package.my_format:MyFormat"    # a nerfloom.DataParser

Environment variables register code that is not installed:

    NERFLOOM_METHODS="my-method=my_file:METHOD,other=..."  NERFLOOM_DATAPARSERS="my-format=my_file:MyFormat"
"""

from __future__ import annotations

import ast
import importlib.util
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from nerfloom.base.errors import ConfigError, nearest
from nerfloom.base.from_nerfstudio import format_answer
from nerfloom.base.other_projects import ELSEWHERE

if TYPE_CHECKING:
    from nerfloom.data.parsed_scene import DataParser
    from nerfloom.method import Method

Kind = Literal["methods", "dataparsers"]
INTERFACE: dict[Kind, int] = {"methods": 3, "dataparsers": 2}
"""Version of the interface that plugins use (docs/plugins.md). A change that breaks plugins raises it."""
CHANGED = "docs/plugins.md, 'Plugins for an older interface', says what to change"
"""Advice for a plugin of an older version."""
VARIABLES = {"methods": "NERFLOOM_METHODS", "dataparsers": "NERFLOOM_DATAPARSERS"}
CALLED = {"methods": "method", "dataparsers": "data format"}


@dataclass(frozen=True)
class Entry:
    """A registered method or data format by its `name`: the `attribute` of a `module`, given by its full name."""

    name: str
    module: str
    attribute: str
    package: str
    """Distribution or environment variable that registers it."""
    problem: str | None = None
    """Reason why it cannot be used, if known before the import."""


@cache
def registered(kind: Kind) -> dict[str, Entry]:
    """Return all entries of a `kind`, methods or dataparsers, by name, sorted; conflicting ones have a `problem`.

    Raises:
        ConfigError: if the environment variable cannot be parsed.
    """
    entries: dict[str, Entry] = {}
    for entry in (*_installed(kind), *_from_environment(kind)):
        other = entries.setdefault(entry.name, entry)
        if (other.module, other.attribute) != (entry.module, entry.attribute):
            conflict = f"it is registered by both {other.package} and {entry.package}; uninstall or rename one of them"
            entries[entry.name] = replace(other, problem=conflict)
    return dict(sorted(entries.items()))


def _installed(kind: Kind) -> Iterator[Entry]:
    for point in entry_points(group=f"nerfloom.{kind}"):
        yield _entry(point.name, point.value, point.dist.name if point.dist else "an unknown package")


def _from_environment(kind: Kind) -> Iterator[Entry]:
    variable = VARIABLES[kind]
    for item in filter(None, (part.strip() for part in os.environ.get(variable, "").split(","))):
        name, _, value = (part.strip() for part in item.partition("="))
        entry = _entry(name, value, variable)
        if not name or entry.problem is not None:
            raise ConfigError(f"{variable} holds '{item}'; it must be name=module:attribute, several with commas")
        yield entry


def _entry(name: str, value: str, package: str) -> Entry:
    module, _, attribute = (part.strip() for part in value.partition(":"))
    problem = None if module and attribute else f"{package} registers '{value}', which is not module:attribute"
    return Entry(name, module, attribute, package, problem)


def summary(entry: Entry) -> str:
    """Return the first line of the docstring of an `entry`'s module without importing it, or the problem with it."""
    if entry.problem is not None:
        return f"({entry.problem})"
    path = _source(entry.module)
    if path is None:
        return f"(its module {entry.module} was not found; it comes with {entry.package})"
    try:
        docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
    except (OSError, SyntaxError, ValueError) as error:
        return f"(its module {path} cannot be read: {type(error).__name__}; it comes with {entry.package})"
    return (docstring or "").split("\n")[0]


def _source(module: str) -> Path | None:
    """Return the file of a module without importing parents: the lookup stops at the first one not imported yet."""
    parts = module.split(".")
    found = 1
    while found < len(parts) and ".".join(parts[:found]) in sys.modules:
        found += 1
    rest = parts[found:]
    try:
        spec = importlib.util.find_spec(".".join(parts[:found]))
    except (ImportError, ValueError):
        return None
    if spec is None:
        return None
    if not rest and spec.origin:
        return Path(spec.origin)
    for folder in spec.submodule_search_locations or ():
        base = Path(folder).joinpath(*rest)
        for candidate in (base.with_suffix(".py"), base / "__init__.py"):
            if candidate.is_file():
                return candidate
    return None


def entry_of(kind: Kind, name: str) -> Entry:
    """Return the entry of a `kind`, methods or dataparsers, that is registered for the `name` that a user typed.

    Raises:
        ConfigError: for an unknown name; the message suggests the nearest one, or the project with that method.
    """
    entries = registered(kind)
    if name in entries:
        return entries[name]
    if kind == "methods" and name in ELSEWHERE:
        raise ConfigError(f"Nerfloom has no method '{name}': {ELSEWHERE[name]}")
    if kind == "dataparsers" and (answer := format_answer(name)) is not None:
        raise ConfigError(answer)
    hint = nearest(name, entries)
    if hint.startswith("Known"):
        hint += f" Install your own, or name it in {VARIABLES[kind]}."
    raise ConfigError(f"unknown {CALLED[kind]} '{name}'. {hint}")


def _load(kind: Kind, name: str) -> Any:
    entry = entry_of(kind, name)
    title = f"{CALLED[kind]} '{name}' of {entry.package}"
    if entry.problem is not None:
        raise ConfigError(f"{CALLED[kind]} '{name}' cannot be used: {entry.problem}")
    try:
        loaded = import_module(entry.module)
        for part in entry.attribute.split("."):
            loaded = getattr(loaded, part)
    except (Exception, SystemExit) as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        top = entry.module.split(".")[0]
        if isinstance(error, ModuleNotFoundError) and error.name == top and entry.package == VARIABLES[kind]:
            reason += f"; add the folder of {top} to PYTHONPATH"
        if _looks_old(error):
            reason += f". It seems to use an older plugin interface than {INTERFACE[kind]}: {CHANGED}"
        raise ConfigError(f"{title} cannot be loaded: {reason}") from error
    interface, ours = getattr(loaded, "interface", INTERFACE[kind]), INTERFACE[kind]
    if interface != ours:
        newer = isinstance(interface, int) and interface > ours
        remedy = "upgrade nerfloom" if newer else CHANGED
        raise ConfigError(f"{title} uses plugin interface {interface}; this version has {ours}; {remedy}")
    return loaded


def _looks_old(error: BaseException) -> bool:
    """Return whether the error is typical of a plugin for the previous interface."""
    if isinstance(error, ImportError):
        return (error.name or "").split(".")[0] in ("framework", "nerfloom")
    return isinstance(error, TypeError) and "Method.__init__()" in str(error)


def load_method(name: str) -> Method:
    """Import the method with the registered `name`.

    Raises:
        ConfigError: for an unknown name, or if its module cannot be imported or holds no method of this plugin
            interface.
    """
    from nerfloom.method import Method

    method = _load("methods", name)
    if not isinstance(method, Method):
        entry = entry_of("methods", name)
        raise ConfigError(f"method '{name}': {entry.module}:{entry.attribute} is not a nerfloom.Method")
    return replace(method, name=name)


def load_dataparser(name: str) -> type[DataParser]:
    """Import the data format with the registered `name`.

    Raises:
        ConfigError: for an unknown name, or if its module cannot be imported or holds no data format of this plugin
            interface.
    """
    from nerfloom.data.parsed_scene import DataParser

    parser = _load("dataparsers", name)
    if not (isinstance(parser, type) and issubclass(parser, DataParser)):
        entry = entry_of("dataparsers", name)
        raise ConfigError(f"data format '{name}': {entry.module}:{entry.attribute} is not a nerfloom.DataParser")
    return parser

"""Names of methods and data formats. Nothing behind a name is imported until it is asked for.

Built-in and third-party ones are registered alike, by entry points of the installed package:

    [project.entry-points."nerfloom.methods"]
    my-method = "my_package.my_method:METHOD"      # a framework.Method

    [project.entry-points."nerfloom.dataparsers"]
    my-format = "my_package.my_format:MyFormat"    # a framework.DataParser
"""

from __future__ import annotations

import ast
import importlib.util
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from framework.errors import ConfigError, DataError, nearest

if TYPE_CHECKING:
    from framework.dataset import DataParser
    from framework.model import Method

Kind = Literal["methods", "dataparsers"]


@cache
def registered(kind: Kind) -> dict[str, EntryPoint]:
    """Entry points by name.

    Raises: ConfigError where two packages register the same name for different things.
    """
    found: dict[str, EntryPoint] = {}
    for entry in entry_points(group=f"nerfloom.{kind}"):
        other = found.setdefault(entry.name, entry)
        if other.value != entry.value:
            packages = " and ".join(e.dist.name if e.dist else e.value for e in (other, entry))
            raise ConfigError(f"'{entry.name}' is registered by both {packages}; uninstall one of them")
    return dict(sorted(found.items()))


def summary(entry: EntryPoint) -> str:
    """The first line of the docstring of the module behind an entry point, read without importing it."""
    path = _source(entry.module)
    if path is None:
        return "(its module was not found)"
    try:
        docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
    except (OSError, SyntaxError, ValueError):
        return "(its module cannot be read)"
    return (docstring or "").split("\n")[0]


def _source(module: str) -> Path | None:
    """The file a module would be imported from. Only the top-level package is asked, for asking imports parents."""
    top, *rest = module.split(".")
    try:
        spec = importlib.util.find_spec(top)
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


def _load(kind: Kind, name: str) -> Any:
    known = registered(kind)
    singular = "method" if kind == "methods" else "data format"
    if name not in known:
        raise ConfigError(f"unknown {singular} '{name}'. {nearest(name, known)}")
    entry = known[name]
    try:
        return entry.load()
    except Exception as error:
        package = entry.dist.name if entry.dist else entry.module
        raise ConfigError(
            f"{singular} '{name}' of package {package} cannot be loaded: {type(error).__name__}: {error}"
        ) from error


def load_method(name: str) -> Method:
    """Import a method by name.

    Raises: ConfigError for an unknown name, or where its module cannot be imported.
    """
    method: Method = _load("methods", name)
    return method


def load_dataparser(name: str) -> type[DataParser]:
    """Import a data format by name.

    Raises: ConfigError for an unknown name, or where its module cannot be imported.
    """
    parser: type[DataParser] = _load("dataparsers", name)
    return parser


def recognize(path: Path | None) -> str:
    """The name of the data format of a folder; the embedded scene for None.

    Raises: DataError where the folder is missing, or none or several formats recognise it.
    """
    if path is None:
        return "procedural"
    if not path.is_dir():
        raise DataError(f"--data {path}: there is no such folder")
    matches = [name for name in registered("dataparsers") if load_dataparser(name).recognizes(path)]
    if len(matches) == 1:
        return matches[0]
    known = ", ".join(registered("dataparsers"))
    if not matches:
        raise DataError(f"--data {path}: no known data format is found there. Known: {known}")
    raise DataError(f"--data {path}: could be {' or '.join(matches)}; name one after the flags, as in '{matches[0]}'")

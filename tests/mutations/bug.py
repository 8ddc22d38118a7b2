"""A bug to plant: one text in one file, replaced by another."""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

from tests.mutations import bugs


@dataclass(frozen=True)
class Bug:
    """Something that a programmer could have written instead, and that changes what a user gets."""

    name: str
    kind: str
    """What it spoils: comparison, data, poses, ..."""
    file: str
    """From the repository's root."""
    old: str
    """Found exactly once in the file."""
    new: str
    means: str
    """For a user, in a line."""

    def lines(self, root: Path) -> range:
        """The numbers, from 1, of the lines that `old` is on."""
        before = (root / self.file).read_text(encoding="utf-8").partition(self.old)[0]
        first = before.count("\n") + 1
        return range(first, first + self.old.rstrip("\n").count("\n") + 1)

    @contextmanager
    def planted(self, root: Path) -> Iterator[None]:
        """The bug is in the tree at `root` meanwhile."""
        path = root / self.file
        text = path.read_text(encoding="utf-8")
        try:
            _write(path, text.replace(self.old, self.new))
            yield
        finally:
            _write(path, text)


def _write(path: Path, text: str) -> None:
    """With no bytecode left: it is told from newer text by size and whole seconds only."""
    for stale in path.parent.glob(f"__pycache__/{path.stem}.*.pyc"):
        stale.unlink()
    path.write_text(text, encoding="utf-8")


def all_bugs() -> tuple[Bug, ...]:
    """Of every module in `bugs`, by kind."""
    modules = sorted(module.name for module in iter_modules(bugs.__path__))
    return tuple(bug for name in modules for bug in import_module(f"{bugs.__name__}.{name}").BUGS)


def faults_of(bugs: Iterable[Bug], root: Path) -> list[str]:
    """What keeps a list of bugs from being planted in the tree at `root`, a line each."""
    bugs = tuple(bugs)
    twice = [name for name, count in Counter(bug.name for bug in bugs).items() if count > 1]
    return [f"{name}: two bugs have this name" for name in twice] + [
        f"{bug.name}: {fault}" for bug in bugs if (fault := _fault(bug, root)) is not None
    ]


def _fault(bug: Bug, root: Path) -> str | None:
    path = root / bug.file
    if not path.is_file():
        return f"there is no file {bug.file}"
    text = path.read_text(encoding="utf-8")
    if text.count(bug.old) != 1:
        return f"{bug.file} has its old text {text.count(bug.old)} times, not once: {bug.old!r}"
    if path.suffix == ".py":
        try:
            same = _meaning(text) == _meaning(text.replace(bug.old, bug.new))
        except SyntaxError as error:
            return f"what it makes of {bug.file} is no Python: {error}"
        if same:
            return f"it leaves {bug.file} as it is"
    return None


@lru_cache(maxsize=8)
def _meaning(text: str) -> str:
    """What Python reads in a text. Raises: SyntaxError."""
    return ast.dump(ast.parse(text))

"""A mutant: the package with one expression or statement changed, and the test that must fail for it.

A change is a rule on the syntax tree, such as ``A.clamp(min=0)`` to ``A``: a single capital letter stands for any
expression, the same letter for the same one. So neither layout nor the names behind a letter matter. It is
planted while the module is imported; no file is written.
"""

from __future__ import annotations

import ast
import importlib.abc
import importlib.machinery
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

ROOT = Path(__file__).parents[2]
BESIDE = {"methods", "dataparsers"}
"""Packages of `nerfloom` that are not in framework/."""
IGNORED = {"ctx", "kind", "type_comment"}
"""Fields of syntax trees that do not tell two expressions apart."""


class NotPlantable(Exception):
    """The rule does not say one place of the present source."""


@dataclass(frozen=True)
class Mutant:
    """One change of one function."""

    name: str
    function: str
    """Qualified name in its module, such as ``Cameras.rays``; empty for the module itself."""
    old: str
    """An expression or a statement. It must match once."""
    new: str
    """The replacement; a letter stands for the same expression as in `old`."""
    means: str
    """The effect for a user."""
    test: str
    """The test that must fail: its path in tests/, ``::``, and its name."""
    module: str = ""
    which: int | None = None
    """Which of several matches it is, from 0."""

    def tree(self, source: str) -> ast.Module:
        """Return the syntax tree of the module's source with the change.

        Raises: NotPlantable.
        """
        tree = ast.parse(source)
        return ast.fix_missing_locations(_Replaced(*self.change(tree)).visit(tree))

    def change(self, tree: ast.Module) -> tuple[ast.AST, ast.AST]:
        """Return the node of the module's syntax tree that is exchanged, and its replacement.

        Raises: NotPlantable.
        """
        old, new = _pattern(self.old), _pattern(self.new)
        if isinstance(old, ast.Expr) and isinstance(new, ast.Expr):
            old, new = old.value, new.value
        functions = list(_named(tree, self.function))
        if not functions:
            raise NotPlantable(f"{self.name}: {self.module} has no {self.function}")
        matches = [
            (node, bound)
            for function in functions
            for node in _preorder(function)
            if _matches(old, node, bound := dict[str, ast.expr]())
        ]
        if self.which is None and len(matches) > 1:
            raise NotPlantable(f"{self.name}: {self.old!r} matches {len(matches)} places; say which")
        if len(matches) <= (self.which or 0):
            raise NotPlantable(f"{self.name}: {self.old!r} matches {len(matches)} places of {self.where}")
        node, bound = matches[self.which or 0]
        changed = ast.copy_location(_Filled(bound).visit(new), node)
        if ast.dump(changed) == ast.dump(node):
            raise NotPlantable(f"{self.name}: it changes nothing")
        return node, changed

    @property
    def where(self) -> str:
        """Module and function."""
        return ".".join(filter(None, (self.module, self.function)))


class Planter(importlib.abc.MetaPathFinder):
    """Imports one module with a mutant in it."""

    def __init__(self, mutant: Mutant) -> None:
        self.mutant = mutant

    def plant(self) -> None:
        """Let the module be imported with the mutant from now on.

        Raises: NotPlantable if it was imported before.
        """
        if self.mutant.module in sys.modules:
            raise NotPlantable(f"{self.mutant.name}: {self.mutant.module} is imported already")
        sys.meta_path.insert(0, self)

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Find the mutant's module as it would be without, with another loader."""
        if name != self.mutant.module:
            return None
        others = (finder.find_spec(name, path, target) for finder in sys.meta_path if finder is not self)
        spec = next(filter(None, others), None)
        if spec is not None and spec.origin is not None:
            spec.loader = _Loader(name, spec.origin, self.mutant)
        return spec


class _Loader(importlib.machinery.SourceFileLoader):
    """Compiles a file with a mutant in it, and reads and writes no bytecode."""

    def __init__(self, name: str, path: str, mutant: Mutant) -> None:
        super().__init__(name, path)
        self.mutant = mutant

    def get_code(self, fullname: str) -> CodeType:
        return compile(self.mutant.tree(Path(self.path).read_text("utf-8")), self.path, "exec", dont_inherit=True)


def source_of(module: str) -> Path:
    """Return the file of a module of the package, without importing anything. Raises: NotPlantable."""
    first, *rest = module.split(".")[1:]
    path = (ROOT / first if first in BESIDE else ROOT / "framework" / first).joinpath(*rest)
    for file in (path.with_suffix(".py"), path / "__init__.py"):
        if file.is_file():
            return file
    raise NotPlantable(f"there is no module {module}")


def _pattern(text: str) -> ast.stmt:
    (statement,) = ast.parse(text).body
    return statement


def _is_letter(node: ast.AST) -> bool:
    return isinstance(node, ast.Name) and re.fullmatch("[A-Z]", node.id) is not None


def _named(tree: ast.AST, name: str) -> Iterator[ast.AST]:
    """The functions and classes of a qualified name; of a conditional definition there may be two."""
    if not name:
        yield tree
        return
    first, _, rest = name.partition(".")
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            if node.name == first:
                yield from _named(node, rest)
        elif isinstance(node, ast.stmt):
            yield from _named(node, name)


def _preorder(node: ast.AST) -> Iterator[ast.AST]:
    """All nodes in the order of the source, an outer one before its inner ones."""
    yield node
    for child in ast.iter_child_nodes(node):
        yield from _preorder(child)


def _matches(pattern: Any, node: Any, bound: dict[str, ast.expr]) -> bool:
    """Whether a node matches a pattern; the expressions of its letters are added to `bound`."""
    if isinstance(pattern, list):
        alike = isinstance(node, list) and len(pattern) == len(node)
        return alike and all(_matches(*pair, bound) for pair in zip(pattern, node, strict=True))
    if not isinstance(pattern, ast.AST):
        return type(pattern) is type(node) and pattern == node
    if _is_letter(pattern) and isinstance(node, ast.expr):
        before = bound.setdefault(pattern.id, node)  # type: ignore[attr-defined]
        return before is node or ast.dump(before) == ast.dump(node)
    if type(pattern) is not type(node):
        return False
    fields = (name for name in pattern._fields if name not in IGNORED)
    return all(_matches(getattr(pattern, name, None), getattr(node, name, None), bound) for name in fields)


class _Filled(ast.NodeTransformer):
    """Replaces letters by their expressions."""

    def __init__(self, bound: dict[str, ast.expr]) -> None:
        self.bound = bound

    def visit_Name(self, node: ast.Name) -> ast.expr:
        return self.bound[node.id] if _is_letter(node) else node


class _Replaced(ast.NodeTransformer):
    """Exchanges one node."""

    def __init__(self, old: ast.AST, new: ast.AST) -> None:
        self.old, self.new = old, new

    def visit(self, node: ast.AST) -> Any:
        return self.new if node is self.old else self.generic_visit(node)

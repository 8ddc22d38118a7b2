"""Which tests run which lines: recorded once, asked for every bug."""

from __future__ import annotations

import ast
import hashlib
import json
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import fmean

from tests.mutations.bug import Bug
from tests.mutations.copy import PACKAGES

OWN = "tests/mutations/"
"""The tool's tests."""
Lines = dict[str, dict[str, list[int]]]
"""File -> line -> contexts (indices) that ran it. A context is a test, or a fixture that several tests share."""


@dataclass
class Reach:
    """What a recorded run of the tests has run."""

    digests: dict[str, str]
    """File -> digest of its content, sources and tests."""
    contexts: list[str] = field(default_factory=list)
    lines: Lines = field(default_factory=dict)
    fixtures: dict[str, list[str]] = field(default_factory=dict)
    """Test -> contexts of the shared fixtures that it uses."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Test -> how long it took."""

    @property
    def files(self) -> set[str]:
        """Where the tests are."""
        return {name.partition("::")[0] for name in self.seconds}

    def tests(self, bug: Bug, root: Path) -> list[str]:
        """The tests that could notice a bug, those that will tell soonest first."""
        of_file = self.lines.get(bug.file, {})
        wanted = lines_to_ask(bug, root) if self.digests.get(bug.file) == digest(root / bug.file) else None
        asked = of_file if wanted is None else [str(line) for line in wanted if str(line) in of_file]
        found = {self.contexts[index] for line in asked for index in of_file[line]}
        if not found:  # what only runs in a process that was killed leaves no record
            found = set(self.seconds)
        able = (name for name in self.seconds if name in found or found & set(self.fixtures[name]))
        return self._in_order(name for name in able if not name.startswith(OWN))  # which see every bug in the list

    def _in_order(self, tests: Iterable[str]) -> list[str]:
        """Short and narrow tests first; those of a file that share a fixture together, or it would be made anew."""
        groups: defaultdict[str, list[str]] = defaultdict(list)
        for name in tests:
            shares = any(not context.startswith("session ") for context in self.fixtures[name])
            groups[name.partition("::")[0] if shares else name].append(name)

        def cost(group: list[str]) -> float:
            return sum(self.seconds[name] + 0.01 for name in group) * fmean(self._widths[name] for name in group)

        return [name for group in sorted(groups.values(), key=cost) for name in group]

    @property
    def _widths(self) -> dict[str, int]:
        """Test -> how many lines it ran."""
        if not hasattr(self, "_counted"):
            counts: defaultdict[str, int] = defaultdict(int)
            for of_file in self.lines.values():
                for indices in of_file.values():
                    for index in indices:
                        counts[self.contexts[index]] += 1
            self._counted = {
                name: 10 + counts[name] + sum(counts[context] for context in self.fixtures[name])
                for name in self.seconds
            }
        return self._counted

    def without(self, files: Iterable[str]) -> Reach:
        """What is known but for the tests of some files."""
        gone = set(files)
        kept = [name for name in self.seconds if name.partition("::")[0] not in gone]
        return Reach(
            dict(self.digests),
            list(self.contexts),
            self.lines,
            {name: self.fixtures[name] for name in kept},
            {name: self.seconds[name] for name in kept},
        )

    def add(self, other: Reach) -> None:
        """What another record knows, too."""
        place = {name: index for index, name in enumerate(self.contexts)}
        for name in other.contexts:
            if name not in place:
                place[name] = len(self.contexts)
                self.contexts.append(name)
        for file, of_file in other.lines.items():
            mine = self.lines.setdefault(file, {})
            for line, indices in of_file.items():
                known = set(mine.get(line, ())) | {place[other.contexts[index]] for index in indices}
                mine[line] = sorted(known)
        self.fixtures.update(other.fixtures)
        self.seconds.update(other.seconds)

    def save(self, path: Path) -> None:
        """As JSON."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(asdict(self)))

    @classmethod
    def load(cls, path: Path) -> Reach:
        """Raises: OSError, ValueError where there is none."""
        return cls(**json.loads(path.read_text()))


def read_record(folder: Path, root: Path) -> tuple[Reach, list[str]]:
    """What the processes of a recorded run have left in `folder`; and the tests that failed."""
    import coverage

    recorded = coverage.Coverage(config_file=str(folder / "coveragerc"))
    recorded.combine([str(folder)], keep=True)
    data = recorded.get_data()
    reach = Reach(digests(root))
    places: dict[str, int] = {}
    for file in data.measured_files():
        of_file: dict[str, list[int]] = {}
        for line, contexts in data.contexts_by_lineno(file).items():
            named = [name for name in contexts if name]
            of_file[str(line)] = sorted(places.setdefault(name, len(places)) for name in named)
        reach.lines[Path(file).relative_to(root).as_posix()] = of_file
    reach.contexts = list(places)
    failed: list[str] = []
    for path in folder.glob("tests-*.json"):
        content = json.loads(path.read_text())
        reach.fixtures.update(content["fixtures"])
        reach.seconds.update({name: content["seconds"][name] for name in content["fixtures"]})
        failed += content["failed"]
    return reach, failed


def digest(path: Path) -> str:
    """Of a file's content."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def digests(root: Path) -> dict[str, str]:
    """File -> digest, of all sources and tests."""
    files = (file for folder in (*PACKAGES, "tests") for file in sorted((root / folder).rglob("*.py")))
    return {file.relative_to(root).as_posix(): digest(file) for file in files}


def lines_to_ask(bug: Bug, root: Path) -> set[int] | None:
    """Lines of which one is run by whatever runs the bug; None for what is run when its module is imported."""
    tree = ast.parse((root / bug.file).read_text(encoding="utf-8"))
    asked: set[int] = set()
    for line in bug.lines(root):
        path = [node for node in _statements(tree) if _spans(node, line)]
        functions = [node for node in path if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))]
        if not functions:
            return None
        inner, outer = path[-1], functions[-1]
        if inner is outer:  # its signature: whatever runs the function
            asked |= set(range(outer.body[0].lineno, (outer.end_lineno or outer.lineno) + 1))
        else:
            asked |= set(range(inner.lineno, _header_end(inner) + 1))
    return asked


def _statements(tree: ast.AST) -> Iterator[ast.stmt]:
    """All, outer before inner."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.stmt):
            yield node
        yield from _statements(node)


def _spans(node: ast.stmt, line: int) -> bool:
    decorators = getattr(node, "decorator_list", [])
    first = min([node.lineno, *(decorator.lineno for decorator in decorators)])
    return first <= line <= (node.end_lineno or node.lineno)


def _header_end(node: ast.stmt) -> int:
    """The last line before a compound statement's body; of a simple statement its last."""
    body = getattr(node, "body", None)
    return max(node.lineno, body[0].lineno - 1) if body else node.end_lineno or node.lineno

"""Docstrings say in a sentence what a function does, and describe each of its arguments.

The rules are PEP 257's and Google's. ruff has some of them, but D417 looks only at docstrings that have an `Args:`
section, DOC102 is a preview, and neither knows that an overriding method inherits its docstring. So all of them are
here, on the syntax tree alone.
"""

import ast
import re
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import TypeGuard

import pytest
from torch import nn

ROOT = Path(__file__).parents[1]
FOLDERS = ("framework", "methods", "dataparsers")
FILES = sorted(file.relative_to(ROOT).as_posix() for folder in FOLDERS for file in (ROOT / folder).rglob("*.py"))

FRAGMENTS = re.compile(
    "Of|That|What|Which|Whose|Who|Where|When|Why|How|While|Until|As|Than|If|Unless|Whether|Because|Since|Though|"
    "Although|And|Or|But|Nor|So|Yet|Not|It|Its|They|Their|He|She|We|Our|You|Your|This|These|Those|There|Here|Same|Such|"
    "Both|Also|Too|Again|Then|Thus|To|In|On|At|By|For|From|With|Without|Into|Onto|Over|Under|After|Before|Between|"
    "Behind|Beside|Through"
)
"""First words of a line that lacks its noun: conjunctions, question words, prepositions, and pronouns, which point at
something that the reader of an index has not read."""
DETERMINERS = re.compile("A|An|The|All|Any|Each|Every|Some|No|None|One|Two|Three|True|False|Most|More|Many")
"""First words of a noun phrase. A module, a class or a property is a thing; a function does something, so that its
docstring starts with a verb in the imperative, as in numpy's reference: "Return the ..."."""
SECTIONS = ("Args", "Attributes", "Returns", "Yields", "Raises")
"""Google's sections. A heading has a line of its own, and the entries are indented below it."""
EXTERNAL_BASES = {"nn.Module": nn.Module}
"""Base classes from other packages with methods that are overridden here."""

Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
written = cache(ast.unparse)
"""The source of a node; bases of classes are asked for once for each of their methods."""


@pytest.fixture(scope="module", autouse=True)
def _forgotten() -> Iterator[None]:
    """A million objects, which every search for garbage in the tests after these would go through."""
    yield
    for kept in (written, _parsed, _classes):
        kept.cache_clear()


def problems(module: ast.Module, classes: dict[str, ast.ClassDef]) -> Iterator[str]:
    """Violations of the rules in a module, a line each; `classes` has the classes of all modules by name."""
    classes = classes | {node.name: node for node in module.body if isinstance(node, ast.ClassDef)}
    yield from _text_problems("the module", ast.get_docstring(module), is_function=False)
    for node in filter(_public, module.body):
        yield from _definition_problems(node.name, node, classes)
        for item in filter(_public, node.body if isinstance(node, ast.ClassDef) else []):
            name = f"{node.name}.{item.name}"
            if not _overrides(item.name, node, classes):
                yield from _definition_problems(name, item, classes)
            elif text := ast.get_docstring(item):
                yield from _text_problems(name, text, is_function=True)


def _public(node: ast.AST) -> TypeGuard[Definition]:
    return isinstance(node, Definition) and not node.name.startswith("_") and not _decorated(node, "overload")


def _decorated(node: Definition, *names: str) -> bool:
    calls = (item.func if isinstance(item, ast.Call) else item for item in node.decorator_list)
    return any(written(call).split(".")[-1] in names for call in calls)


def _overrides(name: str, owner: ast.ClassDef, classes: dict[str, ast.ClassDef]) -> bool:
    """Whether a base class of `owner` has a method or a field of this name."""
    for base in map(written, owner.bases):
        ancestor = classes.get(base.partition("[")[0].split(".")[-1])
        if hasattr(EXTERNAL_BASES.get(base), name):
            return True
        if ancestor is None or ancestor is owner:
            continue
        if name in map(_name, ancestor.body) or _overrides(name, ancestor, classes):
            return True
    return False


def _name(node: ast.stmt) -> str | None:
    target = node.target if isinstance(node, ast.AnnAssign) else None
    return target.id if isinstance(target, ast.Name) else getattr(node, "name", None)


def _definition_problems(name: str, node: Definition, classes: dict[str, ast.ClassDef]) -> Iterator[str]:
    text = ast.get_docstring(node)
    is_class = isinstance(node, ast.ClassDef)
    yield from _text_problems(name, text, not is_class and not _decorated(node, "property", "cached_property"))
    arguments, covered = _arguments(node)
    described = _entries(text or "", "Args")
    yield from (f"{name} has no argument `{argument}`" for argument in described if argument not in arguments)
    if isinstance(node, ast.ClassDef):
        covered |= {argument for argument in arguments if _overrides(argument, node, classes)}
    covered |= {*described, *_entries(text or "", "Attributes"), *_in_backticks(text or "")}
    yield from (f"{name} does not describe `{argument}`" for argument in arguments if argument not in covered)


def _arguments(node: Definition) -> tuple[list[str], set[str]]:
    """Names of arguments, and those described outside the docstring: fields below themselves, or in `__init__`."""
    if not isinstance(node, ast.ClassDef):
        spec = node.args
        given = [*spec.posonlyargs, *spec.args, *spec.kwonlyargs, *filter(None, (spec.vararg, spec.kwarg))]
        names = [item.arg for item in given if not item.arg.startswith("_") and item.arg not in ("self", "cls")]
        return names, {item.arg for item in given if _said_by_type(item)}
    init = next((item for item in node.body if getattr(item, "name", None) == "__init__"), None)
    if init is not None:
        text = ast.get_docstring(init) or ""
        names, said = _arguments(init)
        return names, {*said, *_entries(text, "Args"), *_in_backticks(text)}
    if not _decorated(node, "dataclass") and "NamedTuple" not in map(written, node.bases):
        return [], set()
    names, described = [], set()
    for item, after in pairwise([*node.body, ast.Pass()]):
        if isinstance(item, ast.AnnAssign) and "ClassVar" not in written(item.annotation):
            names += [written(item.target)] * (not written(item.target).startswith("_"))
            if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                described.add(written(item.target))
    return names, described


def _said_by_type(argument: ast.arg) -> bool:
    """Whether an argument is called like its type, such as `scene: Scene` and the settings `config: NerfactoConfig`."""
    kind = "" if argument.annotation is None else written(argument.annotation).split("[")[0].split(".")[-1]
    return kind.lower() == argument.arg or (argument.arg == "config" and kind.removesuffix("T").endswith("Config"))


def _in_backticks(text: str) -> set[str]:
    return {word for code in re.findall(r"`([^`]+)`", text) for word in re.findall(r"\w+", code)}


def _entries(text: str, section: str) -> list[str]:
    """Names that a section of a docstring describes: `name: text`, or `name, other: text`."""
    _, found, rest = ("\n" + text).partition(f"\n{section}:\n")
    lines = [line for line in rest.split("\n\n")[0].split("\n") if found]
    heads = [match[1] for line in lines if (match := re.match(r" {4}([*\w, ]+?)(?: \([^)]*\))?:( |$)", line))]
    return [name.strip(" *") for head in heads for name in head.split(",")]


def _text_problems(name: str, text: str | None, is_function: bool) -> Iterator[str]:
    if text is None:
        yield f"{name} has no docstring"
        return
    first, *rest = text.split("\n")
    word = re.split(r"[\W_]", first)[0]
    if not first.endswith("."):
        yield f"{name}: the first line is no whole sentence with a full stop: {first}"
    if rest and rest[0]:
        yield f"{name}: no empty line follows the first"
    if not re.match(r"[A-Z0-9(`'\"]", first):
        yield f"{name}: the first line starts with neither a capital letter, a shape nor code: {first}"
    if FRAGMENTS.fullmatch(word) or (is_function and DETERMINERS.fullmatch(word)):
        yield f"{name}: the first line is no sentence of its own: {first}"
    if is_function and re.fullmatch(r"[A-Z]\w*[a-rtv-z]s", word):  # not Pass, not Focus
        yield f"{name}: the first word is no verb in the imperative: {first}"
    for line in rest:
        if line.lstrip().startswith(tuple(f"{section}:" for section in SECTIONS)) and not line.endswith(":"):
            yield f"{name}: '{line.strip()}' belongs on lines of its own below the heading"


@cache
def _parsed(file: str) -> ast.Module:
    return ast.parse((ROOT / file).read_text(encoding="utf-8"))


@cache
def _classes() -> dict[str, ast.ClassDef]:
    # If two classes have one name, others derive from the class in the room nearer to the root.
    files = sorted(FILES, key=lambda file: file.count("/"), reverse=True)
    return {node.name: node for file in files for node in _parsed(file).body if isinstance(node, ast.ClassDef)}


def test_docstrings() -> None:
    """All files are checked at once: a test of its own for each would take longer."""
    found = {file: list(problems(_parsed(file), _classes())) for file in FILES}
    assert {file: lines for file, lines in found.items() if lines} == {}


GOOD = '''"""Noise of a known size."""
class Base:
    """A source of noise."""
    def draw(self, count: int) -> int:
        """Draw `count` samples."""
@dataclass(frozen=True)
class Noise(Base):
    """Uniform noise.

    Args:
        size: half of its width.
    """
    size: float
    shift: float
    """Middle."""
    KINDS: ClassVar[int] = 1
    @property
    def width(self) -> float:
        """The whole width."""
    def draw(self, count):
        return count
class Scaled(nn.Module):
    """Noise times a factor."""
    def __init__(self, factor):
        """Scale by `factor`."""
    def forward(self, noise):
        return noise
def passes(noise, *others, _seed=0):
    """Pass `noise` on.

    Args:
        others: what follows.

    Returns:
        Noise and others.

    Raises:
        ValueError: if there is none.
    """
'''


def test_good_docstrings_are_accepted() -> None:
    assert list(problems(ast.parse(GOOD), {})) == []


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("known size.", "known size", "the module: the first line is no whole sentence"),
        ('"""Noise of a known size."""', "", "the module has no docstring"),
        ("Noise of a", "noise of a", "the module: the first line starts with neither"),
        ("A source", "Of a source", "Base: the first line is no sentence"),
        ("Draw `count`", "The `count`", "Base.draw: the first line is no sentence"),
        ("Draw `count`", "Draws `count`", "Base.draw: the first word is no verb"),
        ("Draw `count`", "Draw count", "Base.draw does not describe `count`"),
        ("Uniform noise.\n\n", "Uniform noise.\n", "Noise: no empty line"),
        ("        size: half of its width.\n", "", "Noise does not describe `size`"),
        ('    """Middle."""\n', "", "Noise does not describe `shift`"),
        ("size: half", "sizes, size: half", "Noise has no argument `sizes`"),
        ("(Base)", "", "Noise.draw has no docstring"),
        ("`factor`", "a factor", "Scaled does not describe `factor`"),
        ("forward", "backward", "Scaled.backward has no docstring"),
        ("`noise`", "noise", "passes does not describe `noise`"),
        ("others: what", "rest: what", "passes has no argument `rest`"),
        ("others: what", "rest: what", "passes does not describe `others`"),
        ("Raises:\n        ", "Raises: ", "passes: 'Raises: ValueError: if there is none.' belongs"),
    ],
)
def test_bad_docstrings_are_refused(old: str, new: str, complaint: str) -> None:
    assert GOOD.count(old) == 1
    found = list(problems(ast.parse(GOOD.replace(old, new)), {}))
    assert [problem for problem in found if problem.startswith(complaint)], found

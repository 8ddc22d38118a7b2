"""The house: imports run one way, files and functions stay small, everything public has a docstring."""

import ast
import dataclasses
import functools
import importlib
import inspect
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

import nerfloom

ROOT = Path(__file__).parents[1]
PACKAGES = ("framework", "methods", "dataparsers")
FILES = sorted(file for package in PACKAGES for file in (ROOT / package).rglob("*.py"))


def named(file: Path) -> str:
    """A file's path from the root, for messages."""
    return file.relative_to(ROOT).as_posix()


@functools.cache
def tree(file: Path) -> ast.Module:
    """A file's syntax, by that of the oldest supported Python."""
    return ast.parse(file.read_text(encoding="utf-8"), feature_version=(3, 10))


def statements(node: ast.AST) -> Iterator[ast.AST]:
    """All statements below a node. To walk through their expressions, too, would take most of the time."""
    for name in ("body", "orelse", "finalbody", "handlers", "cases"):
        for item in getattr(node, name, ()):
            yield item
            yield from statements(item)


@pytest.fixture(scope="module", autouse=True)
def _forgotten() -> Iterator[None]:
    """A million objects, which every search for garbage in the tests after these would go through."""
    yield
    tree.cache_clear()


def module_of(file: Path) -> str:
    """The full name of a file's module: the folders at the root are parts of one package."""
    folder, *rest = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(["nerfloom", *({"framework": ()}.get(folder, (folder,))), *rest])


def imports(items: Iterable[ast.AST]) -> set[str]:
    """Modules named by import statements, `from a import b` as a and a.b."""
    found = set()
    for item in items:
        if isinstance(item, ast.Import):
            found |= {alias.name for alias in item.names}
        elif isinstance(item, ast.ImportFrom) and item.module:
            found |= {item.module} | {f"{item.module}.{alias.name}" for alias in item.names}
    return found


@pytest.mark.medium
def test_the_framework_knows_no_method_and_no_format() -> None:
    unknown = {  # the registry finds them by name
        "framework": ("nerfloom.methods", "nerfloom.dataparsers"),
        "methods": ("nerfloom.dataparsers",),
        "dataparsers": ("nerfloom.methods",),
    }
    found = {
        f"{named(file)} imports {name}"
        for file in FILES
        for name in imports(statements(tree(file)))
        if f"{name}.".startswith(tuple(f"{each}." for each in unknown[file.relative_to(ROOT).parts[0]]))
        or name.split(".")[0] in PACKAGES
    }
    assert found == set()


@pytest.mark.medium
def test_python_3_10_syntax() -> None:
    """The oldest supported Python must be able to compile every file."""
    assert len(FILES) > 30
    for file in FILES:
        tree(file)
    assert sys.version_info >= (3, 10)


def test_sizes() -> None:
    assert [named(file) for file in FILES if len(file.read_text(encoding="utf-8").splitlines()) > 400] == []
    methods = (ROOT / "methods").glob("[!_]*.py")
    assert [named(file) for file in methods if len(file.read_text(encoding="utf-8").splitlines()) > 250] == []
    functions = [(file, n) for file in FILES for n in statements(tree(file)) if isinstance(n, ast.FunctionDef)]
    long = [(named(file), n.name) for file, n in functions if (n.end_lineno or 0) - n.lineno + 1 > 65]
    assert long == []


def undocumented(file: Path) -> list[str]:
    """Public definitions without a docstring; a method that overrides or implements one inherits it."""
    missing = [] if ast.get_docstring(tree(file)) or file.name == "py.typed" else ["the module"]
    for node in tree(file).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
            if not ast.get_docstring(node):
                missing.append(node.name)
            if isinstance(node, ast.ClassDef) and not node.bases:
                missing += [
                    f"{node.name}.{item.name}"
                    for item in node.body
                    if isinstance(item, ast.FunctionDef)
                    and not item.name.startswith("_")
                    and not ast.get_docstring(item)
                    and not {getattr(d, "id", "") for d in item.decorator_list} & {"property"}
                ]
    return missing


def test_everything_public_has_a_docstring() -> None:
    implements_protocol = {"uniform.py", "shapes.py", "progress.py"}
    missing = [
        f"{named(file)}: {name}"
        for file in FILES
        for name in undocumented(file)
        if not (file.name in implements_protocol and "." in name)
    ]
    assert missing == []


def test_the_public_interface_is_documented_and_complete() -> None:
    assert len(nerfloom.__all__) > 10
    for name in nerfloom.__all__:
        thing = getattr(nerfloom, name)
        assert inspect.getdoc(thing), name
        if inspect.isclass(thing):
            for member, value in vars(thing).items():
                if inspect.isfunction(value) and not member.startswith("_"):
                    assert inspect.getdoc(getattr(thing, member)), f"{name}.{member}"
    with pytest.raises(AttributeError, match="no attribute 'Nonsense'"):
        _ = nerfloom.Nonsense


def test_every_setting_has_a_help_text() -> None:
    """The string under a field is its help on the command line. A base class describes RANGES and the like."""
    checked = 0
    for file in FILES:
        for node in statements(tree(file)):
            if not (isinstance(node, ast.ClassDef) and node.name.endswith(("Config", "Flags"))):
                continue
            bases = {getattr(base, "id", "") for base in node.bases}
            inherited = {name for b in bases - {"", "Protocol"} for name in _declared(file, b)}
            for item, after in zip(node.body, [*node.body[1:], None], strict=True):
                if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name):
                    described = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
                    assert described or item.target.id in inherited, f"{file.name}: {node.name}.{item.target.id}"
                    checked += 1
    assert checked > 40


def _declared(file: Path, base: str) -> set[str]:
    """Settings, and class variables, that a class or one that it derives from declares."""
    kind = getattr(importlib.import_module(module_of(file)), base, object)
    settings = {f.name for f in dataclasses.fields(kind)} if dataclasses.is_dataclass(kind) else set()
    notes = {name: note for each in kind.__mro__ for name, note in inspect.get_annotations(each).items()}
    return settings | {name for name, note in notes.items() if str(note).startswith("ClassVar")}


LAYERS = (
    ("base",),
    ("jobs",),
    ("geometry",),
    ("kernels",),
    ("cameras",),
    ("data",),
    ("scene",),
    ("encodings",),
    ("fields",),
    ("samplers",),
    ("rendering",),
    ("renderable",),
    ("plug_and_play",),
    ("losses",),
    ("splats", "octrees"),
    ("levels",),
    ("blocks",),
    ("model",),
    ("ray_model", "gaussian_model", "octree_model"),
    ("method",),
    ("registry",),
    ("evaluation",),
    ("training",),
    ("video",),
    ("export",),
    ("edit",),
    ("viewer",),
    ("processing", "comparison", "downloads", "stress", "testing", "integrations", "benchmarks"),
    ("opened",),
    ("cli",),
    ("runs",),
)
"""Rooms of `framework`. Each imports only those above it, anywhere in a file."""


def _room(module: str) -> int | None:
    """The place of a module's room in LAYERS; None for other packages."""
    parts = module.split(".")
    if parts[0] != "nerfloom" or len(parts) < 2:
        return None
    return next((level for level, rooms in enumerate(LAYERS) if parts[1] in rooms), None)


def _runtime_imports(file: Path) -> set[str]:
    """`imports` anywhere in a file, less those for type checkers alone."""
    found = list(statements(tree(file)))
    checked = [item for item in found if isinstance(item, ast.If) and "TYPE_CHECKING" in ast.dump(item.test)]
    return imports(found) - {name for item in checked for name in imports(statements(item))}


@pytest.mark.medium
def test_imports_run_one_way_through_the_rooms() -> None:
    upwards = []
    for file in FILES:
        module = module_of(file)
        level = _room(module)
        if level is None or module == "nerfloom.registry":  # it finds modules above it by name
            continue
        for name in sorted(_runtime_imports(file)):
            other = _room(name)
            if other is not None and other > level:
                upwards.append(f"{module} imports {name}")
    assert upwards == []


def test_nothing_is_at_the_root_of_the_framework_but_what_joins_the_rooms() -> None:
    rooms = {room for layer in LAYERS for room in layer}
    found = {path.stem for path in (ROOT / "framework").iterdir() if path.name != "__pycache__"}
    assert found - rooms <= {"__init__", "py", "templates"}


FRONTS = ("nerfloom", "nerfloom.edit", "nerfloom.testing")
"""Packages that gather names from elsewhere, for notebooks and authors of plugins."""


def test_names_are_imported_from_the_file_that_defines_them() -> None:
    files, known = {module_of(file).removesuffix(".__init__"): file for file in FILES}, set(FILES)

    @functools.cache
    def borrowed(module: str) -> set[str]:
        found = (node for node in statements(tree(files[module])) if isinstance(node, ast.ImportFrom))
        return {name.asname or name.name for node in found for name in node.names}

    elsewhere = []
    for file in [*FILES, *(ROOT / "benchmarks").rglob("*.py"), *(ROOT / "tests").rglob("*.py")]:
        for node in statements(tree(file) if file in known else ast.parse(file.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.ImportFrom) or node.module not in files or node.module in FRONTS:
                continue
            named = {alias.name for alias in node.names if f"{node.module}.{alias.name}" not in files}
            names = sorted(named & borrowed(node.module))
            elsewhere += [f"{file.relative_to(ROOT)}: {node.module} borrows {name}" for name in names]
    assert elsewhere == []


def test_compiled_functions_get_addresses_of_tensors_that_live() -> None:
    """An address of a tensor that only its own expression holds is freed memory when the compiled function reads it."""

    def makes(node: ast.AST) -> bool:
        return any(isinstance(inner, ast.Call) for inner in ast.walk(node))

    dangling, found = [], 0
    for file in FILES:
        for call in ast.walk(tree(file)):
            if not isinstance(call, ast.Call):
                continue
            if isinstance(call.func, ast.Attribute):
                name, owner = call.func.attr, call.func.value
            else:
                name, owner = getattr(call.func, "id", ""), call.func
            tensor = owner if name in ("data_ptr", "arguments", "addresses") else None
            if name in ("pointer", "ray_arguments", "distance_arguments", "network_arguments"):
                tensor = call.args[0] if call.args else None
            if tensor is None:
                continue
            found += 1
            if makes(tensor):
                dangling.append(f"{named(file)}:{call.lineno}: {ast.unparse(call)}")
    assert not dangling
    assert found > 300


def test_no_import_circles() -> None:
    """Imports anywhere in a file count: an import in a function is late, and hides a circle."""
    names = {module_of(file): file for file in FILES if file.name != "__init__.py"}
    edges = {name: _runtime_imports(file) & names.keys() for name, file in names.items()}
    finished: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, " -> ".join([*path, name])
        if name not in finished:
            for other in edges[name]:
                visit(other, (*path, name))
            finished.add(name)

    for name in names:
        visit(name, ())
    assert len(finished) == len(names) > 20

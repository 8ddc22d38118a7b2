"""Each declaration of a C function in Python agrees with its C++ source: a wrong one would read foreign memory."""

import importlib
import pkgutil
import re
from pathlib import Path

import pytest

import nerfloom.cameras.cameras
import nerfloom.data.pixels.batch
import nerfloom.kernels
from nerfloom.kernels import native

SOURCES = Path(native.__file__).parent
LETTERS = {"int64_t": "q", "int": "i", "float": "f", "double": "d"}


def without_comments(text: str) -> str:
    return re.sub(r"/\*.*?\*/|//[^\n]*", "", text, flags=re.DOTALL)


def exported(text: str) -> dict[str, tuple[str, ...]]:
    """The parameters' types of every exported function that returns a status: a letter, or p and its target's type."""
    found = {}
    for name, parameters in re.findall(r"\bEXPORT\s+int\s+(\w+)\s*\(([^)]*)\)", without_comments(text)):
        found[name] = tuple(kind(parameter) for parameter in parameters.split(",") if parameter.strip())
    return found


def kind(parameter: str) -> str:
    """For example, `float* out` is p:float, and `int64_t count` is q."""
    words = re.sub(r"\bconst\b|\w+\s*$", "", parameter).split()  # the last word is the name
    target, stars = re.fullmatch(r"(\w+)\s*([*\s]*)", " ".join(words)).groups()
    return f"p:{target}" if stars else LETTERS[target]


def declared() -> dict[str, list[native.Function]]:
    """The declarations of every module that can have any, by the name of their function."""
    found_modules = pkgutil.walk_packages(nerfloom.kernels.__path__, "nerfloom.kernels.")
    names = [module.name for module in found_modules if not module.name.endswith(("_triton", "triton_launch"))]
    modules = [importlib.import_module(name) for name in names]
    found: dict[str, list[native.Function]] = {}
    for module in (*modules, nerfloom.cameras.cameras, nerfloom.data.pixels.batch):
        for value in vars(module).values():
            if isinstance(value, native.Function):
                found.setdefault(value.name, []).append(value)
    return found


def problem(function: native.Function, parameters: tuple[str, ...]) -> str | None:
    """The difference between a declaration and the source; None if there is none."""
    *read, written = parameters if function.result else (*parameters, "")
    letters = "".join(parameter[0] for parameter in read)
    if letters != function.arguments:
        return f"{function.name} takes {letters}, not {function.arguments}"
    if function.result and (not written.startswith("p:") or LETTERS.get(written[2:]) != function.result):
        return f"{function.name} writes {written} through its last argument, not {function.result}"
    return None


CPP = sorted(SOURCES.glob("*/*.cpp"))
EXPORTED = {name: kinds for file in CPP for name, kinds in exported(file.read_text()).items()}
DECLARED = declared()


def test_every_exported_function_is_declared_once_and_every_declared_one_exported() -> None:
    assert set(DECLARED) == set(EXPORTED)
    assert {name for name, functions in DECLARED.items() if len(functions) > 1} == set()
    count = sum(len(re.findall(r"^EXPORT int ", file.read_text(), flags=re.MULTILINE)) for file in CPP)
    assert len(EXPORTED) == count > 30


def test_declarations_are_made_at_the_top_of_modules() -> None:
    """Where the comparison finds them."""
    root = Path(nerfloom.__file__).parent
    made = sum(len(re.findall(r"\bnative\.Function\(", file.read_text())) for file in root.rglob("*.py"))
    assert made == len(DECLARED)


def test_every_declaration_is_its_source() -> None:
    found = {name: problem(DECLARED[name][0], kinds) for name, kinds in EXPORTED.items()}
    assert {name: said for name, said in found.items() if said is not None} == {}


@pytest.mark.parametrize(
    ("arguments", "result", "said"),
    [
        ("pqfid", "q", None),
        ("pqfi", "q", "takes pqfid, not pqfi"),  # one too few
        ("pqfidp", "q", "takes pqfid, not pqfidp"),  # one too many
        ("pfqid", "q", "takes pqfid, not pfqid"),  # another order
        ("pqdid", "q", "takes pqfid, not pqdid"),  # a double for a float
        ("piffd", "q", "takes pqfid, not piffd"),  # an int for 64 bits
        ("qqfid", "q", "takes pqfid, not qqfid"),  # a number for a pointer
        ("pqfid", "i", "writes p:int64_t through its last argument, not i"),
        ("pqfid", "", "takes pqfidp, not pqfid"),  # no address for its result
    ],
)
def test_a_wrong_declaration_is_found(arguments: str, result: str, said: str | None) -> None:
    source = """
    // EXPORT int other(int a);
    EXPORT int sample(const float* const* parts /* of each, */,
                      int64_t count, float step, int threads, const double rate, int64_t* found) {
        return call(1, 2);
    }
    """
    parsed = exported(source)
    assert parsed == {"sample": ("p:float", "q", "f", "i", "d", "p:int64_t")}
    found = problem(native.Function("sample", arguments, result), parsed["sample"])
    assert found == (None if said is None else f"sample {said}")


def test_a_type_without_a_letter_is_an_error() -> None:
    with pytest.raises(KeyError, match="size_t"):
        exported("EXPORT int sample(size_t count) {")


def test_one_letter_more_or_less_is_found_in_every_declaration() -> None:
    for name, (function, *_) in DECLARED.items():
        letters = function.arguments
        for arguments in (letters[1:], letters + "i", letters.replace("i", "q", 1)):
            if arguments != letters:
                assert problem(native.Function(name, arguments, function.result), EXPORTED[name]), (name, arguments)

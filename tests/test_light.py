"""The plain installation stays light: every package that it brings is listed here, with sizes."""

import ast
import re
from importlib.metadata import PackageNotFoundError, distribution, version
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).parents[1]

TORCHS = {"torch", "filelock", "fsspec", "jinja2", "markupsafe", "mpmath", "networkx", "setuptools", "sympy"} | {
    "typing-extensions"
}
"""torch, and its requirements on a CPU; jinja2 is ours, too."""
OURS = {
    "absl-py": "tensorboard",
    "docstring-parser": "tyro",
    "grpcio": "tensorboard",
    "imageio": "reading and writing images",
    "markdown": "tensorboard",
    "markdown-it-py": "rich",
    "mdurl": "rich",
    "numpy": "arrays",
    "packaging": "tensorboard",
    "pillow": "reading and writing images",
    "protobuf": "tensorboard",
    "pycolmap": "poses of photographs",
    "pygments": "rich",
    "pyyaml": "settings",
    "rich": "messages and progress bars",
    "tensorboard": "curves in a browser",
    "tensorboard-data-server": "tensorboard",
    "typeguard": "tyro",
    "tyro": "the command line",
    "werkzeug": "tensorboard",
}
"""Package that comes without an extra, beside torch's -> its purpose, or the other package that needs it."""
ONLY_SOMEWHERE = re.compile(r"nvidia-.+|cuda-.+|triton|importlib-.+|zipp|tomli|exceptiongroup|colorama")
"""Packages that torch needs for CUDA, or that replace parts that an older Python or Windows lacks."""
MAX_MEGABYTES = 310
"""Maximum size of the packages in `OURS`, installed, without compiled Python."""


def declared() -> list[Requirement]:
    """The dependencies in pyproject.toml, without extras."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    block = re.search(r"^dependencies = (\[.*?^\])", text, re.MULTILINE | re.DOTALL)
    assert block is not None
    return [Requirement(line) for line in ast.literal_eval(block[1])]


def closure(wanted: list[Requirement]) -> set[str]:
    """Names of all packages that an installation of `wanted` brings, from the metadata of those installed here."""
    found: set[tuple[str, str]] = set()
    waiting = [(requirement, "") for requirement in wanted]
    while waiting:
        requirement, extra = waiting.pop()
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": extra}):
            continue
        name = canonicalize_name(requirement.name)
        for option in ("", *requirement.extras):
            if (name, option) in found:
                continue
            found.add((name, option))
            try:
                needs = distribution(name).requires or []
            except PackageNotFoundError:
                pytest.skip(f"{name} is not installed, so its requirements are not known")
            waiting += [(Requirement(line), option) for line in needs]
    return {name for name, _ in found}


def megabytes(name: str) -> float:
    """Size of an installed package, as its RECORD states it."""
    return sum(file.size or 0 for file in distribution(name).files or []) / 1e6


def test_no_package_comes_unnoticed() -> None:
    if Version(version("tensorboard")) < Version("2.20"):
        pytest.skip("tensorboards before 2.20 need more packages: six, and before 2.16 google-auth")
    found = {name for name in closure(declared()) if not ONLY_SOMEWHERE.fullmatch(name)}
    assert found - TORCHS - set(OURS) == set(), "if it must be, list it above, and in README's count"
    assert set(OURS) - found == set(), "if it is no longer needed, take it out above, and of README's count"


def test_what_the_packages_weigh() -> None:
    found = closure(declared())
    sizes = {name: megabytes(name) for name in found}
    ours = sum(sizes[name] for name in found & set(OURS))
    heaviest = sorted(((size, name) for name, size in sizes.items()), reverse=True)[:8]
    total = sum(sizes.values())
    print(f"{len(found) + 1} packages with nerfloom, {total:.0f} MB, of which {ours:.0f} MB are not torch's")
    print(", ".join(f"{name} {size:.0f} MB" for size, name in heaviest))
    assert ours < MAX_MEGABYTES


def test_a_package_that_is_added_is_noticed() -> None:
    assert "scipy" in closure([*declared(), Requirement("scipy>=1.11")])
    assert "scipy" not in closure([*declared(), Requirement("scipy>=1.11; extra == 'test'")])
    assert "imageio-ffmpeg" in closure([Requirement("imageio[ffmpeg]")])

"""The command `ns-new-method`: a new package with a small, working method as a starting point."""

from __future__ import annotations

import importlib.util
import keyword
import re
from dataclasses import dataclass
from pathlib import Path
from string import Template

from nerfloom.base.errors import ConfigError
from nerfloom.cli.common import entry_point
from nerfloom.cli.flags import HELP, read_flags
from nerfloom.registry import registered

TEMPLATES = Path(__file__).parents[1] / "templates" / "method"
SUFFIX = ".template"
"""Extension of the templates."""
USAGE = """\
usage: ns-new-method NAME [--dir DIR]

Writes a package with a small, working method into the folder NAME, or DIR: one file with the method, for you to change,
its tests, and a pyproject.toml for pip. NAME, such as my-method, is the method's name for ns-train.
"""


@dataclass(frozen=True)
class NewMethodFlags:
    """Write a package with a small, working method as a starting point."""

    dir: Path | None = None
    """Folder to write, new or empty. Default: the method's name."""


@entry_point
def main(arguments: list[str]) -> None:
    """Run ns-new-method on the `arguments` of the process."""
    if not arguments or set(HELP) & set(arguments):
        print(USAGE)
        return
    name = arguments[0]
    if name.startswith("-"):
        raise ConfigError(f"the method's name comes first, before {name}, as in 'ns-new-method my-method'")
    flags = read_flags(NewMethodFlags, f"ns-new-method {name}", arguments[1:])
    check_name(name)
    folder = flags.dir or Path(name)
    write_package(name, folder)
    print(
        f"{folder} holds the method '{name}', all of it in {folder / 'src' / module_of(name)}.py. Next:\n"
        f"  pip install -e '{folder}[test]'\n"
        f"  ns-train {name} --max-seconds 60\n"
        f"  python -m pytest {folder}"
    )


def check_name(name: str) -> None:
    """Check that `name` is valid for a new method and not taken.

    Raises:
        ConfigError: if it is invalid or taken.
    """
    if not re.fullmatch(r"[a-z][a-z0-9]*(-[a-z0-9]+)*", name):
        raise ConfigError(f"'{name}' is invalid: use lowercase letters, digits and single dashes, as in my-method")
    if name in registered("methods"):
        raise ConfigError(f"the method '{name}' already exists; choose another name")
    module = module_of(name)
    if keyword.iskeyword(module) or importlib.util.find_spec(module) is not None:
        raise ConfigError(f"the method's module would be '{module}', which is taken already; choose another name")


def module_of(name: str) -> str:
    """Return the name of a method's Python module: my_method for the `name` my-method."""
    return name.replace("-", "_")


def package_of(name: str) -> dict[str, str]:
    """Return the files of the package of a new method `name`: their text by path, relative to its folder."""
    words = {"name": name, "module": module_of(name), "Class": "".join(part.capitalize() for part in name.split("-"))}
    files = {}
    for path in sorted(TEMPLATES.rglob(f"*{SUFFIX}")):
        relative = path.relative_to(TEMPLATES).as_posix().removesuffix(SUFFIX)
        content = path.read_text(encoding="utf-8")
        files[Template(relative).substitute(words)] = Template(content).substitute(words)
    return files


def write_package(name: str, folder: Path) -> None:
    """Write the package of a new method `name` to a `folder`, new or empty.

    Raises:
        ConfigError: if the folder is not empty or cannot be written.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(f"{folder} already exists and is not overwritten; choose another --dir")
    try:
        for relative, content in package_of(name).items():
            path = folder / relative
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(content, encoding="utf-8", newline="\n")
    except OSError as error:
        raise ConfigError(f"cannot write {folder}: {error.strerror}; choose another --dir") from error


if __name__ == "__main__":
    main()

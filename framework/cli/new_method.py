"""ns-new-method: a package with a method in it, to be made into your own."""

from __future__ import annotations

import importlib.util
import keyword
import re
from dataclasses import dataclass
from pathlib import Path
from string import Template

from framework.base.errors import ConfigError
from framework.base.registry import registered
from framework.cli.common import run_command

TEMPLATES = Path(__file__).parents[1] / "templates" / "method"
SUFFIX = ".template"
USAGE = """\
usage: ns-new-method NAME [--dir DIR]

Writes a package with a small, working method into the folder NAME, or DIR: one file to make your own, its tests, and
what pip needs to know. NAME, such as my-method, is what ns-train will call it.
"""


@dataclass(frozen=True)
class NewMethodFlags:
    """Write a package with a small, working method, to be made into your own."""

    dir: Path | None = None
    """Folder to write into, new or empty; the method's name if not given."""


def main() -> None:
    """The ns-new-method command."""
    run_command(_command)


def _command(arguments: list[str]) -> None:
    if not arguments or {"-h", "--help"} & set(arguments):
        print(USAGE)
        return
    name = arguments[0]
    if name.startswith("-"):
        raise ConfigError(f"the method's name comes first, before {name}, as in 'ns-new-method my-method'")
    import tyro

    flags = tyro.cli(NewMethodFlags, prog=f"ns-new-method {name}", args=arguments[1:])
    check_name(name)
    folder = flags.dir or Path(name)
    write_package(name, folder)
    print(
        f"{folder} holds the method '{name}', all of it in {folder / 'src' / module_of(name)}.py. Next:\n"
        f"  pip install -e {folder}\n"
        f"  ns-train {name} --max-seconds 60\n"
        f"  pytest {folder}"
    )


def check_name(name: str) -> None:
    """Refuse a name that a method cannot have, or that is taken.

    Raises: ConfigError that says why.
    """
    if not re.fullmatch(r"[a-z][a-z0-9]*(-[a-z0-9]+)*", name):
        raise ConfigError(f"'{name}' is no method's name: lowercase letters, digits and single dashes, as my-method")
    if name in registered("methods"):
        raise ConfigError(f"there is a method '{name}' already; choose another name")
    module = module_of(name)
    if keyword.iskeyword(module) or importlib.util.find_spec(module) is not None:
        raise ConfigError(f"the method's module would be '{module}', which is taken already; choose another name")


def module_of(name: str) -> str:
    """The Python module of a method: my_method for my-method."""
    return name.replace("-", "_")


def package_of(name: str) -> dict[str, str]:
    """The files of a new method's package: their places in its folder, and what they hold."""
    words = {
        "name": name,
        "module": module_of(name),
        "Class": "".join(part.capitalize() for part in name.split("-")),
    }
    found = {}
    for path in sorted(TEMPLATES.rglob(f"*{SUFFIX}")):
        place = path.relative_to(TEMPLATES).as_posix().removesuffix(SUFFIX)
        content = path.read_text(encoding="utf-8")
        found[Template(place).substitute(words)] = Template(content).substitute(words)
    return found


def write_package(name: str, folder: Path) -> None:
    """Write a new method's package.

    Raises: ConfigError where something is there already, or the folder cannot be written.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(f"{folder} is there already, and nothing is overwritten; choose another --dir")
    try:
        for place, content in package_of(name).items():
            path = folder / place
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(content, encoding="utf-8", newline="\n")
    except OSError as error:
        raise ConfigError(f"cannot write {folder}: {error.strerror}") from error


if __name__ == "__main__":
    main()

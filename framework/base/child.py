"""A command of ours in another process, with the package that this process runs.

`python -m` would put the working folder first on the path, where a file framework.py, or a checkout without compiled
kernels, would be taken for the package. So children run this file, which knows where the package lies.
"""

import sys
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]
"""The folder of this package."""


def python_command(module: str, *arguments: object) -> list[str]:
    """The words that run a module of this package as a program, whatever folder they are run in.

    Args:
        module: its full name, as in framework.cli.train.
    """
    return [sys.executable, str(Path(__file__).resolve()), module, *map(str, arguments)]


def _use_this_package() -> None:
    """Let imports find this package: the path has the folder of this file, and may lack the one of the package."""
    here = Path(__file__).resolve().parent
    sys.path[:] = [place for place in sys.path if not place or Path(place).resolve() != here]
    from importlib.util import find_spec

    found = find_spec(PACKAGE.name)
    if found is None or found.origin is None or Path(found.origin).resolve().parent != PACKAGE:
        sys.path.insert(0, str(PACKAGE.parent))


if __name__ == "__main__":
    import runpy

    _use_this_package()
    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)

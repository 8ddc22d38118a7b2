"""Running a module of this package in a child process, with the package that this process has imported.

`python -m` would put the working directory first on `sys.path`, where a file framework.py, or a checkout without
compiled kernels, would be imported instead. So a child process runs this file, which finds its own package.
"""

import sys
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]
"""Directory of this package."""


def python_command(module: str, *arguments: object) -> list[str]:
    """Return the command line that runs a module of this package as a program, from any working directory.

    Args:
        module: full name of the module, such as framework.cli.train.
        arguments: command-line arguments, converted to strings.
    """
    return [sys.executable, str(Path(__file__).resolve()), module, *map(str, arguments)]


def _use_this_package() -> None:
    """Make imports find this package: Python puts this file's directory on the path, not the package's parent."""
    here = Path(__file__).resolve().parent
    sys.path[:] = [entry for entry in sys.path if not entry or Path(entry).resolve() != here]
    from importlib.util import find_spec

    spec = find_spec(PACKAGE.name)
    if spec is None or spec.origin is None or Path(spec.origin).resolve().parent != PACKAGE:
        sys.path.insert(0, str(PACKAGE.parent))


if __name__ == "__main__":
    import runpy

    _use_this_package()
    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)

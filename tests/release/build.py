"""The two distributions, as `python -m build` makes them, and twine's check of their metadata."""

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

from tests.release.problem import Problem
from tests.release.sources import ROOT

LEADS_ASTRAY = ("PYTHONPATH", "PYTHONHOME", "PIP_CONSTRAINT", "NERFLOOM_METHODS", "NERFLOOM_DATAPARSERS")
"""Variables that lead Python or pip to other files than the checked ones."""


def run(words: list[object], folder: Path, **variables: str) -> str:
    """Run a program in a folder; return its output. A failure is a problem."""
    environment = {name: value for name, value in os.environ.items() if name not in LEADS_ASTRAY} | variables
    done = subprocess.run([str(word) for word in words], cwd=folder, env=environment, capture_output=True, text=True)
    if done.returncode:
        said = (done.stdout + done.stderr).strip().splitlines()
        raise Problem(f"{' '.join(map(str, words))} ended with {done.returncode}:\n" + "\n".join(said[-25:]))
    return done.stdout + done.stderr


def build(folder: Path) -> tuple[Path, Path]:
    """Build the sdist, and from it the wheel, in an isolated environment with the declared build tools."""
    for package in ("build", "twine"):
        if find_spec(package) is None:
            raise Problem(f"{package} is not installed; pip install -c constraints.txt -e '.[release]'")
    folder.mkdir(parents=True, exist_ok=True)
    for old in [*folder.glob("*.whl"), *folder.glob("*.tar.gz")]:
        old.unlink()
    run([sys.executable, "-m", "build", "--outdir", folder, ROOT], folder, NERFLOOM_VARIANTS="all")
    (sdist,), (wheel,) = list(folder.glob("*.tar.gz")), list(folder.glob("*.whl"))
    return sdist, wheel


def check_metadata(sdist: Path, wheel: Path) -> str:
    """Check metadata and the rendering of README, as a package index does."""
    run([sys.executable, "-m", "twine", "check", "--strict", sdist, wheel], sdist.parent)
    return "twine check --strict: metadata and README's rendering pass, of both"

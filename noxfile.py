"""The fast tests under every Python and torch that we claim (`make test-versions`), and under the lowest dependencies.

What is not at hand is named as skipped in nox's summary, and is untested. Packages come from wherever pip is set up to
look; on Linux, set it up for torch's CPU builds first, or each session installs CUDA's libraries.

    nox -s "tests-3.12(torch='2.6.0')"           one of them
    nox -s lowest -- tests/test_config.py        with arguments for pytest, in place of the fast set
    NERFLOOM_TORCH=2.13.0 nox -s lowest          the lowest dependencies, but this torch
    nox -s without_torch                         what needs no torch, under every Python, in a minute each
    nox -s cluster                               jobs on a real Ray cluster, with the version in constraints.txt

docs/platforms.md says what ran and what did not.
"""

import os
import re
from pathlib import Path

import nox

ROOT = Path(__file__).parent
PYTHONS = ("3.10", "3.11", "3.12", "3.13")
FAST = ("-n", "auto", "--dist", "worksteal", "-m", "not slow")
TORCHLESS = (
    *("tests/downloads/test_fetch.py", "tests/downloads/test_unpack.py", "tests/processing/test_images.py"),
    *("tests/processing/test_retrieval.py", "tests/processing/test_video_frames.py", "tests/release/test_release.py"),
    *("tests/test_arrays.py", "tests/test_documents.py", "tests/test_errors.py", "tests/test_light.py"),
)
"""Tests that run where torch is not installed."""
COMPILE = """
import pathlib, warnings
warnings.simplefilter("error")
for folder in ("framework", "methods", "dataparsers", "tests", "examples", "docs"):
    for path in pathlib.Path(folder).rglob("*.py"):
        compile(path.read_text(encoding="utf-8"), str(path), "exec")
"""
"""Compiles every file; a warning is an error."""
PINS = (ROOT / "constraints.txt").read_text(encoding="utf-8")
PROJECT = (ROOT / "pyproject.toml").read_text(encoding="utf-8")


def lowest_versions() -> dict[str, str]:
    """Return the lower bounds of the runtime dependencies, by package."""
    block = re.search(r"^dependencies = \[(.*?)^\]", PROJECT, re.MULTILINE | re.DOTALL)
    assert block is not None
    return dict(re.findall(r'"([\w-]+)>=([\d.]+)', block[1]))


def newest_torch() -> str:
    """Return the version of torch that the project is developed with."""
    pinned = re.search(r"^torch==(\S+)$", PINS, re.MULTILINE)
    assert pinned is not None
    return pinned[1]


def three_parts(version: str) -> str:
    """Return `version` with the zeros that are left out, as 2.6.0 for 2.6."""
    return ".".join([*version.split("."), "0", "0"][:3])


TORCHES = (three_parts(lowest_versions()["torch"]), newest_torch())


def install(session: nox.Session, torch: str, pins: list[str]) -> None:
    """Install this package and its tests, with exactly this torch; skip the session where it cannot be had."""
    constraints = Path(session.create_tmp()) / "constraints.txt"
    constraints.write_text("\n".join([f"torch=={torch}", *pins]) + "\n", encoding="utf-8")
    pinned = ("-c", str(constraints))
    session.run("python", "-m", "pip", "install", "--quiet", *pinned, "torch", success_codes=[0, 1], silent=True)
    code = "from importlib.metadata import version; print(version('torch'))"
    found = session.run("python", "-c", code, success_codes=[0, 1], silent=True)
    if isinstance(found, str) and found.strip().split("+")[0] != torch:  # no text if the session is only listed
        session.skip(f"untested: torch {torch} cannot be had here")
    session.install(*pinned, "-e", f"{ROOT}[test]")


def test(session: nox.Session) -> None:
    """Run the fast tests, or those that were named."""
    session.run("python", "-m", "pytest", *(session.posargs or FAST), env={"OMP_WAIT_POLICY": "PASSIVE"})


@nox.session(python=PYTHONS)
@nox.parametrize("torch", TORCHES)
def tests(session: nox.Session, torch: str) -> None:
    """Run the fast tests, with the versions that the project is developed with but for Python and torch."""
    bound = ("torch==", "triton==") if torch != newest_torch() else ("torch==",)  # each torch wants a triton of its own
    install(session, torch, [pin for pin in PINS.splitlines() if not pin.startswith(("#", *bound))])
    test(session)


@nox.session(python=PYTHONS)
def without_torch(session: nox.Session) -> None:
    """Compile every file, and run the tests that need no torch, for versions of Python without a torch here."""
    needs = ("numpy", "scipy", "tyro", "rich", "imageio", "pillow", "PyYAML", "pycolmap", "jinja2", "trimesh")
    session.install("-c", str(ROOT / "constraints.txt"), *needs, "pytest", "hypothesis")
    session.install("--no-deps", "-e", str(ROOT))
    session.run("python", "-c", COMPILE, silent=True)
    plugins = ("--noconftest", "-p", "tests.downloads.conftest")  # the conftest.py of all tests imports torch
    session.run("python", "-m", "pytest", *plugins, *(session.posargs or TORCHLESS))


@nox.session
def cluster(session: nox.Session) -> None:
    """Run the tests of jobs with Ray, which no other extra installs."""
    session.install("-c", str(ROOT / "constraints.txt"), "-e", f"{ROOT}[test,cluster]")
    session.run("python", "-m", "pytest", *(session.posargs or ("tests/jobs",)))


@nox.session
def lowest(session: nox.Session) -> None:
    """Run the fast tests with the lowest versions of the runtime dependencies that pyproject.toml allows."""
    bounds = lowest_versions()
    torch = os.environ.get("NERFLOOM_TORCH", three_parts(bounds.pop("torch")))
    install(session, torch, [f"{name}=={version}" for name, version in bounds.items() if name != "torch"])
    session.run("python", "-m", "pip", "list")
    test(session)

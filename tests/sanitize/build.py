"""The kernels with AddressSanitizer, UndefinedBehaviorSanitizer and libstdc++'s assertions, in their own folder."""

import os
import runpy
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

from setuptools import Extension

from nerfloom.base.device import cpu_features
from nerfloom.kernels.native import NEEDS, SUFFIX

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "build" / "sanitized"
SANITIZERS = ["-fsanitize=address,undefined", "-fno-sanitize-recover=undefined"]
FLAGS = ["-O1", "-g1", "-fPIC", "-fno-omit-frame-pointer", "-D_GLIBCXX_ASSERTIONS", *SANITIZERS]


class Missing(Exception):
    """A requirement of a build with sanitizers is missing."""


@dataclass(frozen=True)
class Sanitized:
    """A library that was built."""

    variant: str
    folder: Path
    preloaded: tuple[Path, ...]
    """Libraries to load before Python: AddressSanitizer, and the C++ library with the exceptions it looks for."""


def runtime() -> tuple[Path, ...]:
    """The libraries that must be loaded first. Raises: Missing."""
    if sys.platform != "linux" or shutil.which("g++") is None:
        raise Missing("it needs g++ on Linux")
    found = []
    for name in ("libasan.so", "libstdc++.so.6"):
        told = subprocess.run(["g++", f"-print-file-name={name}"], capture_output=True, text=True, check=True)
        if not Path(told.stdout.strip()).is_absolute():
            raise Missing(f"g++ has no {name}: install the package libasan")
        found.append(Path(told.stdout.strip()).resolve())
    return tuple(found)


def build() -> Sanitized:
    """The variant that fits this processor best, but for tiles, with the flags of setup.py and of the sanitizers.

    Raises: Missing without compiler or runtime; CalledProcessError where it does not compile.
    """
    preloaded = runtime()
    # Compilers do not see the memory that instructions for tiles access: vector instructions are checked in their
    # place.
    kinds = [name for name in NEEDS if name != "amx_bf16"]
    variant = next(name for name in kinds if cpu_features().issuperset(NEEDS[name]))
    extension = next(e for e in extensions() if e.name.rsplit(".", 1)[-1] == variant)
    FOLDER.mkdir(parents=True, exist_ok=True)
    objects = {source: FOLDER / f"{Path(source).stem}.o" for source in extension.sources}

    def compile_one(source: str) -> None:
        _run("g++", *extension.extra_compile_args, *FLAGS, "-c", source, "-o", str(objects[source]))

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(compile_one, extension.sources))
    library = FOLDER / f"{variant}{SUFFIX}"
    _run("g++", "-shared", *SANITIZERS, *map(str, objects.values()), *extension.extra_link_args, "-o", str(library))
    return Sanitized(variant, FOLDER, preloaded)


def extensions() -> list[Extension]:
    """The extensions that setup.py would build."""
    before = Path.cwd()
    os.chdir(ROOT)
    try:
        with mock.patch("setuptools.setup") as setup:
            runpy.run_path("setup.py")
    finally:
        os.chdir(before)
    found: list[Extension] = setup.call_args.kwargs["ext_modules"]
    return found


def _run(*command: str) -> None:
    subprocess.run(command, cwd=ROOT, check=True)

"""Builds the CPU kernels: plain shared libraries with a C interface, for one instruction set or for each.

They use neither Python nor torch, so one wheel per platform serves every version of both. Without a compiler, the
installation continues without kernels, and it skips instruction sets that the compiler does not know.

Only the library that this machine chooses is built. With NERFLOOM_VARIANTS=all every one is, which takes five times as
long: for wheels, which other machines install.
"""

from __future__ import annotations

import ctypes
import os
import platform
import runpy
import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from threading import Lock

from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext

try:
    from setuptools.command.bdist_wheel import bdist_wheel
except ImportError:  # setuptools before 70.1
    from wheel.bdist_wheel import bdist_wheel

KERNELS = Path("framework/kernels")
SOURCES = sorted(str(path) for path in KERNELS.glob("*/*.cpp"))
FINGERPRINT = runpy.run_path(str(KERNELS / "sources.py"))["fingerprint"](KERNELS)
AVX2 = ["-mavx2", "-mfma"]
AVX512 = ["-mavx512f", "-mavx512bw", "-mavx512dq", "-mavx512vl", "-mprefer-vector-width=512"]
HEADERS = sorted(str(path) for path in KERNELS.glob("*/*.h"))
VARIANTS = {"baseline": []}
if platform.machine().lower() in ("x86_64", "amd64"):
    VARIANTS |= {
        "avx2": AVX2,
        "avx512": [*AVX2, *AVX512],
        "avx512_bf16": [*AVX2, *AVX512, "-mavx512bf16"],
    }
    if sys.platform == "linux":  # where a process can ask for tiles
        VARIANTS["amx_bf16"] = [*VARIANTS["avx512_bf16"], "-mamx-tile", "-mamx-bf16"]


def fitting(variants: dict[str, list[str]]) -> dict[str, list[str]] | None:
    """Return the `variants` with flags -mNAME that Linux lists for this processor; None if it lists none."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return None
    known = next((line.split(":", 1)[1].replace("_", "").split() for line in lines if line.startswith("flags")), [])
    if "amxtile" in known and not gives_tiles():
        known.remove("amxtile")
    needed = {name: [f[2:].replace("-", "") for f in flags if "prefer" not in f] for name, flags in variants.items()}
    return {name: variants[name] for name in variants if set(needed[name]) <= set(known)} if known else None


def gives_tiles() -> bool:
    """Return whether Linux gives this process the processor's tiles, as the library asks (networks/tiles.cpp)."""
    system_call, request, tile_data = 158, 0x1023, 18  # arch_prctl, ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA
    return ctypes.CDLL(None).syscall(system_call, request, tile_data) == 0


HERE = None if os.environ.get("NERFLOOM_VARIANTS") == "all" else fitting(VARIANTS)
VARIANTS = HERE or VARIANTS
# GCC for Windows aligns the stack to 16 bytes, and stores wider vectors there as if it were to more (GCC bug 54412).
MINGW_FLAGS = ["-Wa,-muse-unaligned-vector-move"]
FLAGS = ["-std=c++17", "-O3", "-g0", "-fno-math-errno", "-fno-trapping-math", "-fvisibility=hidden", "-pthread"]
FLAGS.append(f"-DNERFLOOM_SOURCES={FINGERPRINT}")
# Python's own flags, which setuptools puts before these, let signed integers wrap around (-fwrapv). Compilers then do
# not know that a row's elements follow each other, and address each anew: small networks take 3 to 7 % longer, with the
# same bits. No sum in these files leaves its type, which `make sanitize` watches.
NETWORK_FLAGS = ["-fno-wrapv"]


class BuildKernels(build_ext):
    """Compiles the fastest variant for this processor; with NERFLOOM_VARIANTS=all every one that the compiler can."""

    lock = Lock()

    def get_ext_filename(self, fullname: str) -> str:
        suffix = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
        return os.path.join(*fullname.split(".")) + suffix

    def get_export_symbols(self, ext: Extension) -> list[str]:
        return []

    def build_extensions(self) -> None:
        if self.compiler.compiler_type == "msvc":
            self.warn("MSVC cannot compile the CPU kernels, which use Clang's and GCC's vectors: torch alone is used")
            self.extensions = []
            return
        variants, self.extensions = self.extensions, []
        self.done, self.total, self.begun = 0, 0, time.monotonic()
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            for group in [[each] for each in reversed(variants)] if HERE else [variants]:
                self.total += sum(len(each.sources) for each in group)
                jobs = [[pool.submit(self.compile_source, each, path) for path in each.sources] for each in group]
                self.extensions += [each for each, job in zip(group, jobs, strict=True) if self.link(job, each)]
                if self.extensions:
                    return
        self.warn("the CPU kernels could not be built: nerfloom will train much slower on a processor")

    def compile_source(self, ext: Extension, source: str) -> str:
        mingw = self.compiler.compiler_type == "mingw32"
        (path,) = self.compiler.compile(
            [source],
            include_dirs=ext.include_dirs,
            output_dir=os.path.join(self.build_temp, ext.name),  # the variants share their sources
            extra_postargs=[
                *ext.extra_compile_args,
                *(NETWORK_FLAGS if Path(source).name.startswith("mlp") else []),
                *(MINGW_FLAGS if mingw else []),
            ],
            depends=ext.depends,
        )
        self.report(ext, source)
        return path

    def report(self, ext: Extension, source: str) -> None:
        """Say how many files are compiled, and the time left; pip shows it with -v."""
        with self.lock:
            self.done += 1
            left = (time.monotonic() - self.begun) / self.done * (self.total - self.done)
            variant = ext.name.rsplit(".", 1)[-1]
            print(
                f"kernels: {self.done} of {self.total} files, {left:.0f} s left ({variant}: {Path(source).name})",
                flush=True,
            )

    def link(self, compiled: list[Future[str]], ext: Extension) -> bool:
        """Link a variant; if it cannot be built, say why, and return False."""
        # Without MinGW's own libraries, which no other Windows has.
        static = ["-static"] if self.compiler.compiler_type == "mingw32" else []
        path = self.get_ext_fullpath(ext.name)
        try:
            objects = [each.result() for each in compiled]
            flags = [*ext.extra_link_args, *static]
            self.compiler.link_shared_object(objects, path, extra_postargs=flags, target_lang="c++")
        except Exception as error:  # whatever the compiler's wrapper raises
            Path(path).unlink(missing_ok=True)
            self.warn(f"the CPU kernels for {ext.name.rsplit('.', 1)[-1]} are left out: {error}")
            return False
        return True

    def copy_extensions_to_source(self) -> None:
        folder = Path("framework/kernels/lib")
        folder.mkdir(exist_ok=True)
        suffix = Path(self.get_ext_filename("any")).suffix
        for old in folder.glob(f"*{suffix}"):  # of other sources, or no longer the fastest
            old.unlink()
        super().copy_extensions_to_source()


class AnyPythonWheel(bdist_wheel):
    """The wheel depends on the platform, but on no version of Python."""

    def get_tag(self) -> tuple[str, str, str]:
        return "py3", "none", super().get_tag()[2]


# Three folders, one package: nothing else of ours is at the top of site-packages.
PARTS = {"nerfloom": "framework", "nerfloom.methods": "methods", "nerfloom.dataparsers": "dataparsers"}

setup(
    package_dir=PARTS,
    packages=[*PARTS, *(f"{part}.{name}" for part, folder in PARTS.items() for name in find_packages(folder))],
    ext_modules=[
        Extension(
            f"nerfloom.kernels.lib.{name}",
            SOURCES,
            include_dirs=[str(KERNELS)],
            extra_compile_args=[*FLAGS, *flags],
            extra_link_args=["-pthread"] if sys.platform == "linux" else [],
            depends=[*HEADERS],
        )
        for name, flags in VARIANTS.items()
    ],
    cmdclass={"build_ext": BuildKernels, "bdist_wheel": AnyPythonWheel},
)

"""Builds the CPU kernels: plain shared libraries with a C interface, one for each instruction set.

They know nothing of Python or torch, so one wheel a platform serves every Python and every torch version. Where no
compiler is at hand the installation goes on without them. With NERFLOOM_VARIANTS=native only the one that this
machine would choose is built, in a quarter of the time.
"""

from __future__ import annotations

import os
import platform
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

try:
    from setuptools.command.bdist_wheel import bdist_wheel
except ImportError:  # setuptools before 70.1
    from wheel.bdist_wheel import bdist_wheel

SOURCES = sorted(str(path) for path in Path("framework/kernels/csrc").glob("*.cpp"))
AVX2 = ["-mavx2", "-mfma"]
AVX512 = ["-mavx512f", "-mavx512bw", "-mavx512dq", "-mavx512vl", "-mprefer-vector-width=512"]
HEADERS = sorted(str(path) for path in Path("framework/kernels/csrc").glob("*.h"))
VARIANTS = {"baseline": []}
if platform.machine().lower() in ("x86_64", "amd64"):
    VARIANTS |= {
        "avx2": AVX2,
        "avx512": [*AVX2, *AVX512],
        "avx512_bf16": [*AVX2, *AVX512, "-mavx512bf16"],
    }


def native_only(variants: dict[str, list[str]]) -> dict[str, list[str]]:
    """Return the last of `variants` for whose flags -mNAME Linux lists this processor's NAME; all, if it lists none."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return variants
    known = next((line.split(":", 1)[1].replace("_", "").split() for line in lines if line.startswith("flags")), [])
    fitting = [
        name
        for name, flags in variants.items()
        if all(flag[2:] in known for flag in flags if not flag.startswith("-mprefer"))
    ]
    return {name: variants[name] for name in fitting[-1:]} if known else variants


if os.environ.get("NERFLOOM_VARIANTS") == "native":
    VARIANTS = native_only(VARIANTS)
# GCC for Windows aligns the stack to 16 bytes, and stores wider vectors there as if it were to more (GCC bug 54412).
MINGW_FLAGS = ["-Wa,-muse-unaligned-vector-move"]
FLAGS = ["-std=c++17", "-O3", "-g0", "-fno-math-errno", "-fno-trapping-math", "-fvisibility=hidden", "-pthread"]
# Python's own flags, which setuptools puts before these, let signed integers wrap around (-fwrapv). Compilers then do
# not know that a row's elements follow each other, and address each anew: small networks take 3 to 7 % longer, with the
# same bits. No sum in these files leaves its type, which `make sanitize` watches.
NETWORK_FLAGS = ["-fno-wrapv"]


class BuildKernels(build_ext):
    """Compiles every variant, or none."""

    def get_ext_filename(self, fullname: str) -> str:
        suffix = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
        return os.path.join(*fullname.split(".")) + suffix

    def get_export_symbols(self, ext: Extension) -> list[str]:
        return []

    def build_extensions(self) -> None:
        if self.compiler.compiler_type == "msvc":
            self.warn("MSVC cannot compile the CPU kernels, which use Clang's and GCC's vectors: torch alone is used")
            return
        try:
            with ThreadPoolExecutor(os.cpu_count()) as pool:
                jobs = [(ext, source) for ext in self.extensions for source in ext.sources]
                paths = list(pool.map(lambda job: self.compile_source(*job), jobs))
            for ext in self.extensions:
                self.link([path for (owner, _), path in zip(jobs, paths, strict=True) if owner is ext], ext)
        except Exception as error:  # whatever the compiler's wrapper raises
            self.warn(f"the CPU kernels could not be built ({error}): nerfloom will train much slower on a processor")
            for extension in self.extensions:
                Path(self.get_ext_fullpath(extension.name)).unlink(missing_ok=True)

    def compile_source(self, ext: Extension, source: str) -> str:
        mingw = self.compiler.compiler_type == "mingw32"
        (path,) = self.compiler.compile(
            [source],
            output_dir=os.path.join(self.build_temp, ext.name),  # the variants share their sources
            extra_postargs=[
                *ext.extra_compile_args,
                *(NETWORK_FLAGS if Path(source).name.startswith("mlp") else []),
                *(MINGW_FLAGS if mingw else []),
            ],
            depends=ext.depends,
        )
        return path

    def link(self, objects: list[str], ext: Extension) -> None:
        # Without MinGW's own libraries, which no other Windows has.
        static = ["-static"] if self.compiler.compiler_type == "mingw32" else []
        self.compiler.link_shared_object(
            objects, self.get_ext_fullpath(ext.name), extra_postargs=[*ext.extra_link_args, *static], target_lang="c++"
        )

    def get_outputs(self) -> list[str]:
        return [path for path in super().get_outputs() if Path(path).exists()]

    def copy_extensions_to_source(self) -> None:
        built = [e for e in self.extensions if Path(self.build_lib, self.get_ext_filename(e.name)).exists()]
        for extension in built:
            Path(self.get_ext_filename(extension.name)).parent.mkdir(exist_ok=True)
        self.extensions, everything = built, self.extensions
        super().copy_extensions_to_source()
        self.extensions = everything


class AnyPythonWheel(bdist_wheel):
    """The wheel depends on the platform, but on no version of Python."""

    def get_tag(self) -> tuple[str, str, str]:
        return "py3", "none", super().get_tag()[2]


setup(
    ext_modules=[
        Extension(
            f"framework.kernels.lib.{name}",
            SOURCES,
            extra_compile_args=[*FLAGS, *flags],
            extra_link_args=["-pthread"] if sys.platform == "linux" else [],
            depends=[*HEADERS],
        )
        for name, flags in VARIANTS.items()
    ],
    cmdclass={"build_ext": BuildKernels, "bdist_wheel": AnyPythonWheel},
)

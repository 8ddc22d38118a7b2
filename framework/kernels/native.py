"""The library of compiled CPU kernels: choice of the variant for this CPU, and checked calls.

Each kernel's Python file declares its C functions as `Function`, and passes tensors through `pointer`, which checks
them. A C function returns a status, which is raised as an exception here. The library has its own threads
(`kernels/runtime/parallel.h`), in the number that torch is set to use. ctypes releases Python's lock during a call.

The environment variable `NERFLOOM_KERNELS` overrides the choice: a variant's name (baseline, avx2, avx512, avx512_bf16,
amx_bf16), "triton" for Triton's kernels only, or "reference" for PyTorch only. `NERFLOOM_KERNEL_FOLDER` is a folder of
libraries to use instead of the installed one (`make sanitize`).
"""

from __future__ import annotations

import ctypes
import functools
import os
import platform
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nerfloom.base.console import say
from nerfloom.base.device import cpu_features
from nerfloom.base.errors import ConfigError
from nerfloom.base.extras import reinstall_command
from nerfloom.kernels.sources import fingerprint

SOURCES = Path(__file__).parent
FOLDER = Path(os.environ.get("NERFLOOM_KERNEL_FOLDER") or SOURCES / "lib")
_AVX512 = ("avx512f", "avx512bw", "avx512dq", "avx512vl", "fma")
NEEDS: dict[str, tuple[str, ...]] = {
    "amx_bf16": (*_AVX512, "avx512_bf16", "amx_tile", "amx_bf16"),
    "avx512_bf16": (*_AVX512, "avx512_bf16"),
    "avx512": _AVX512,
    "avx2": ("avx2", "fma"),
    "baseline": (),
}
"""CPU features required by each variant, by name, fastest variant first."""
SUFFIX = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
TYPES: dict[str, Any] = {
    "p": ctypes.c_void_p,
    "q": ctypes.c_int64,
    "i": ctypes.c_int,
    "f": ctypes.c_float,
    "d": ctypes.c_double,
}
spent: dict[str, float] | None = None
"""Seconds spent in each kernel, by name; recorded if this is a dictionary (`ns-bench profile-step`)."""


def variant() -> str:
    """Return the name of the variant in use: one of `NEEDS`, or "reference" if there are no compiled kernels.

    Raises:
        ConfigError: if NERFLOOM_KERNELS selects a variant that is unknown or cannot be loaded.
    """
    return _load()[0]


def available() -> bool:
    """Return whether compiled kernels are used."""
    return _load()[1] is not None


@functools.cache
def _load() -> tuple[str, ctypes.CDLL | None]:
    asked = os.environ.get("NERFLOOM_KERNELS", "auto")
    if asked in ("reference", "triton"):
        return "reference", None
    if asked == "auto":
        fitting = [name for name, needs in NEEDS.items() if cpu_features().issuperset(needs)]
    elif asked in NEEDS:
        fitting = [asked]
    else:
        known = ", ".join(("auto", "reference", *NEEDS, "triton"))
        raise ConfigError(f"NERFLOOM_KERNELS is '{asked}'; it must be one of {known}")
    problem = "they were not built"
    for name in fitting:
        path = FOLDER / f"{name}{SUFFIX}"
        if path.is_file():
            try:
                return name, _opened(path)
            except OSError as error:
                problem = str(error)
    if asked != "auto":
        raise ConfigError(f"NERFLOOM_KERNELS asks for '{asked}', but {FOLDER / asked}{SUFFIX} does not load: {problem}")
    others = [name for name in NEEDS if name not in fitting and (FOLDER / f"{name}{SUFFIX}").is_file()]
    if others and problem == "they were not built":
        problem = f"they were built for another processor: {', '.join(others)}"
    say(
        f"note: without its compiled kernels ({problem}) nerfloom trains more than ten times slower on this processor; "
        f"with a C++ compiler ({_compiler_hint()}), install it again: {reinstall_command()}"
    )
    return "reference", None


def _opened(path: Path) -> ctypes.CDLL:
    """Return the library at `path`, after requesting the system's permission for the features it needs.

    Raises:
        OSError: if it does not load, if it was built from sources other than those beside it, so that arguments may
            differ, or if the system denies permission.
    """
    library = ctypes.CDLL(str(path))
    built_from = getattr(library, "built_from", None)
    if built_from is not None:
        built_from.restype = ctypes.c_int64
    if built_from is None or built_from() != fingerprint(SOURCES):
        raise OSError("they were built from other sources")
    ask = getattr(library, "ask_for_tiles", None)
    if ask is not None:
        ask.restype = ctypes.c_char_p
        if problem := ask():
            raise OSError(problem.decode())
    return library


def _compiler_hint() -> str:
    hints = {"Darwin": "'xcode-select --install'", "Windows": "clang or MinGW's g++; MSVC cannot build them"}
    return hints.get(platform.system(), "g++ or clang++")


@functools.cache
def has(name: str) -> bool:
    """Return whether the library in use has a function of this `name`; some variants lack some functions."""
    library = _load()[1]
    return library is not None and hasattr(library, name)


_FAILURES: dict[int, type[Exception]] = {1: MemoryError, 2: IndexError, 3: ValueError}
"""Exception for each status; other statuses than 0 raise a RuntimeError."""


class Function:
    """A C function of the library, looked up at its first call.

    A call raises MemoryError, IndexError, ValueError or RuntimeError, depending on the status that the C function
    returns (kernels/runtime/status.h).

    Args:
        name: name of the C function.
        arguments: types of its arguments, one letter each: p pointer, q 64-bit integer, i int, f float, d double. A
            test compares them with the C++ sources.
        result: type of the value written through an additional last argument, which is not in `arguments`; a call
            returns this value. Empty if there is none.
    """

    def __init__(self, name: str, arguments: str, result: str = "") -> None:
        self.name, self.arguments, self.result = name, arguments, result
        self._bound: Any = None

    def __call__(self, *values: Any) -> Any:
        """Call the function with `values`: numbers, addresses and C arrays."""
        bound = self._bind() if self._bound is None else self._bound
        start = time.perf_counter() if spent is not None else 0.0
        out = TYPES[self.result]() if self.result else None
        status = bound(*values) if out is None else bound(*values, ctypes.byref(out))
        if spent is not None:
            spent[self.name] = spent.get(self.name, 0.0) + time.perf_counter() - start
        if status:
            raise _FAILURES.get(status, RuntimeError)(f"{self.name}: {_last_error()}")
        return None if out is None else out.value

    def _bind(self) -> Any:
        library = _load()[1]
        if library is None:
            raise RuntimeError(f"{self.name} was called without compiled kernels")
        function = getattr(library, self.name)
        function.argtypes = [TYPES[letter] for letter in self.arguments] + [ctypes.c_void_p] * bool(self.result)
        function.restype = ctypes.c_int
        self._bound = function  # set only when complete: another thread may be calling
        return function


def _last_error() -> str:
    library = _load()[1]
    assert library is not None
    library.last_error.restype = ctypes.c_char_p
    return library.last_error().decode(errors="replace")


def pointer(tensor: Tensor, what: str, shape: tuple[int, ...], dtype: torch.dtype = torch.float32) -> int:
    """Return the address of a tensor's data, after checking the properties that kernels rely on.

    Args:
        tensor: a contiguous tensor on the CPU.
        what: name of the tensor, for the error.
        shape: the required shape.
        dtype: the required type.

    Raises:
        ValueError: if the tensor is not contiguous, not on the CPU, or has another shape or type.
    """
    if not tensor.is_cpu:  # tensor.device takes fifteen times as long
        raise ValueError(f"{what} is on {tensor.device}, not on the CPU")
    if tensor.dtype is not dtype:
        raise ValueError(f"{what} has type {tensor.dtype}, not {dtype}")
    if tensor.shape != shape:
        raise ValueError(f"{what} has shape {tuple(tensor.shape)}, not {shape}")
    if not tensor.is_contiguous():
        raise ValueError(f"{what} is not contiguous")
    return tensor.data_ptr()


def pointers(addresses: Sequence[int | None]) -> Any:
    """Return a C array of `addresses`, with null pointers for None; keep it alive during the call."""
    return (ctypes.c_void_p * len(addresses))(*addresses)


def integers(values: tuple[int, ...]) -> Any:
    """Return a C array of 64-bit integers with these `values`."""
    return (ctypes.c_int64 * len(values))(*values)


def doubles(values: Sequence[float]) -> Any:
    """Return a C array of 64-bit floating-point numbers with these `values`."""
    return (ctypes.c_double * len(values))(*values)


_threads: int | None = None


def threads() -> int:
    """Return the number of threads that a kernel may use: the number set in torch."""
    return torch.get_num_threads() if _threads is None else _threads


@contextmanager
def torch_on_one_thread(wanted: bool = True) -> Iterator[None]:
    """Run torch's own operations on one thread, within a `with` block; compiled kernels keep their threads.

    Two pools of threads that wait for work in turn slow each other down. If kernels do most of the work, this costs
    more than torch's small operations gain from threads.

    Args:
        wanted: False to change nothing. Without compiled kernels nothing changes either way.
    """
    global _threads
    if not wanted or _threads is not None or not available():
        yield
        return
    _threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(_threads)
        _threads = None

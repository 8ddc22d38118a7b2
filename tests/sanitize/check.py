"""The kernels' tests on a sanitized library, after bad calls have shown that its sanitizers are awake."""

import os
import subprocess
import sys

from tests.sanitize.build import ROOT, Sanitized

BAD_CALL = """
import torch
from nerfloom.kernels import native
from nerfloom.data.pixels.batch import _gather_colors

pixels = torch.zeros(64, 4, dtype=torch.uint8)
flat, floats = torch.tensor([{index}]), [torch.zeros(3) for _ in range(3)]
assert native.variant() == {variant!r}
_gather_colors(flat.data_ptr(), 1, pixels.data_ptr(), 2**63 - 1, 4, *(values.data_ptr() for values in floats), 1)
print("nobody minded")
"""
"""A pixel is looked up of 64, the kernel being told that there are many more."""
CONTROLS = {64: "heap-buffer-overflow", 2**62: "runtime error: signed integer overflow"}
"""Index of a pixel -> message expected from AddressSanitizer, or from UndefinedBehaviorSanitizer."""
TESTS = [
    "tests/kernels",
    "--ignore=tests/kernels/test_native.py",  # which is about the other libraries
    # Where there is no memory, AddressSanitizer ends the process: its `new` raises nothing.
    "--deselect=tests/kernels/test_threads.py::test_memory_that_is_not_there_is_an_error_and_not_the_end_of_the_process",
]


def check(library: Sanitized) -> int:
    """Run the controls, then the kernels' tests. Returns: the exit status; the last line has the findings."""
    for index, words in CONTROLS.items():
        said = control(library, index)
        if words not in said:
            print(said[-2000:])
            print(f"sanitize: the sanitizers are asleep: pixel {index} of 64 was not called a {words}")
            return 2
    run = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-n",
        "0",
        "--capture=sys",
        "-p",
        "no:cacheprovider",
        "-p",
        "tests.sanitize.called",
        "-m",
        "not slow",
        *TESTS,
    ]
    # A sanitizer's message goes to the file descriptor, which pytest would otherwise keep from an aborted process.
    status = subprocess.run(run, cwd=ROOT, env=environment(library), check=False).returncode
    found = "nothing found" if status == 0 else f"something found, or a test that failed (exit status {status})"
    print(f"sanitize: {library.variant} with address, undefined and library assertions: {found}")
    return status


def control(library: Sanitized, index: int) -> str:
    """The output of a process that looks up a missing pixel."""
    code = BAD_CALL.format(index=index, variant=library.variant)
    run = [sys.executable, "-c", code]
    done = subprocess.run(run, cwd=ROOT, env=environment(library), capture_output=True, text=True, check=False)
    return done.stdout + done.stderr


def environment(library: Sanitized) -> dict[str, str]:
    """Variables of a process that uses the library. Python and torch leak by design."""
    return {
        **os.environ,
        "LD_PRELOAD": ":".join(map(str, library.preloaded)),
        "ASAN_OPTIONS": "detect_leaks=0:allocator_may_return_null=1",
        "UBSAN_OPTIONS": "print_stacktrace=1",
        "NERFLOOM_KERNELS": library.variant,
        "NERFLOOM_KERNEL_FOLDER": str(library.folder),
    }

"""Faulty readers, each with its own fault: fuzzing has to find them."""

import ctypes
import os
import pickle
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from nerfloom.base.errors import DataError
from tests.fuzz.payload import Payload
from tests.fuzz.reader import Nonsense, Reader


def build(folder: Path) -> None:
    (folder / "a.bin").write_bytes(bytes(range(100)))


def if_damaged(misbehave: Callable[[Path], object]) -> Reader:
    def read(folder: Path, scratch: Path) -> None:
        file = folder / "a.bin"
        content = file.read_bytes() if file.is_file() else b""
        if content != bytes(range(100)):
            misbehave(folder)

    return Reader(build, read, ("a.bin",))


def refuse(folder: Path) -> None:
    raise DataError(f"{folder / 'a.bin'} is damaged")


def refuse_in_two_lines(folder: Path) -> None:
    error = DataError("a.bin is damaged")
    error.args = ("a.bin is\ndamaged",)
    raise error


def raise_another_error(folder: Path) -> None:
    raise KeyError("a.bin")


def take_nonsense(folder: Path) -> None:
    raise Nonsense("a focal length of nothing")


def leave(folder: Path) -> None:
    sys.exit(0)


def write_elsewhere(folder: Path) -> None:
    (folder / ".." / "outside" / "more").write_text("here")


def write_where_we_are(folder: Path) -> None:
    Path("here").write_text("here")


def write_to_the_data(folder: Path) -> None:
    (folder / "more").write_text("here")


def remove_a_file_elsewhere(folder: Path) -> None:
    (folder / ".." / "outside" / "secret").rename(folder / ".." / "outside" / "secrets")
    (folder / ".." / "outside" / "secrets").rename(folder / ".." / "outside" / "secret")


def start_a_program(folder: Path) -> None:
    subprocess.run([sys.executable, "--version"], capture_output=True, check=True)


def use_a_shell(folder: Path) -> None:
    os.system("true")


def unpickle(folder: Path) -> None:
    pickle.loads(pickle.dumps(Payload()))


def take_all_memory(folder: Path) -> None:
    bytes(2**40)


def hide_that_memory_ran_out(folder: Path) -> None:
    try:
        bytes(2**40)
    except MemoryError as error:
        raise DataError(f"{folder / 'a.bin'} is damaged") from error


def take_more_and_more_memory(folder: Path) -> None:
    taken = []
    while True:
        taken.append(bytes(2**24))


def fill_the_disk(folder: Path) -> None:
    with (folder.parent / "scratch" / "large").open("wb") as file:
        file.truncate(2**40)


def never_end(folder: Path) -> None:
    while True:
        time.sleep(0.01)


def abort(folder: Path) -> None:
    os.abort()


def read_what_is_not_there(folder: Path) -> None:
    ctypes.string_at(8)


READERS = {
    function.__name__: if_damaged(function)
    for function in (
        refuse, refuse_in_two_lines, raise_another_error, take_nonsense, leave, write_elsewhere, write_where_we_are,
        write_to_the_data, remove_a_file_elsewhere, start_a_program, use_a_shell, unpickle, take_all_memory,
        hide_that_memory_ran_out, take_more_and_more_memory, fill_the_disk, never_end, abort, read_what_is_not_there,
    )
}  # fmt: skip

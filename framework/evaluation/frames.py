"""Frames of a long render, kept on disk until its files are written, so that a stopped render can continue.

They are in FILE.frames/KEY/ beside the rendered file or folder. The key is a hash of everything that the frames depend
on, so frames of one command are never used for another. render.json holds the hashed facts. Frames of a video are
replaced by encoded parts of it while others are rendered (`video/film.py`).
"""

from __future__ import annotations

import errno
import hashlib
import json
import shutil
import time
import zipfile
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from torch import Tensor

from nerfloom.base.atomic import write_atomically
from nerfloom.base.console import say, track
from nerfloom.base.errors import ConfigError
from nerfloom.base.meter import time_text
from nerfloom.evaluation.outputs import Arrays

FACTS = "render.json"
"""Name of the file that describes the render."""
SUFFIX = ".frames"
"""Suffix of the folder of frames, appended to the name of the rendered file."""
TIMED = 2
"""The frame that tells how long the others take. The first also prepares the data that all of them use."""
PIECE = 2**24
"""Number of bytes of a file hashed at a time."""
MAX_PLAIN = 2**31
"""Maximum number of bytes of all frames together for them to be kept as they are. Compressing a frame takes longer than
drawing a simple one."""
LEVEL = 1
"""Level of the compression of larger renders: the fastest."""


@dataclass(frozen=True)
class Frames:
    """Frames on disk."""

    folder: Path
    """Folder of these frames only."""
    count: int
    """Number of frames in the whole render."""
    part_length: int | None = None
    """Minimum number of frames that are encoded together and then removed; None: all stay."""

    @property
    def parts(self) -> list[range]:
        """The indices of the frames of each part, in order. The last part is the longest."""
        length = self.count if self.part_length is None else self.part_length
        starts = [length * number for number in range(max(self.count // length, 1))]
        return [range(*ends) for ends in zip(starts, [*starts[1:], self.count], strict=True)]

    def part_path(self, part: range) -> Path:
        """Return the path of an encoded `part`."""
        return self.folder / f"{part[0]:06d}-{part[-1]:06d}.mp4"

    def path(self, index: int) -> Path:
        """Return the path of frame `index`."""
        return self.folder / f"{index:06d}.npz"

    def read(self, index: int) -> Arrays | None:
        """Return the arrays of frame `index`; None if it is missing or damaged."""
        try:
            with np.load(self.path(index), allow_pickle=False) as content:
                return {name: content[name] for name in content.files}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None

    def __iter__(self) -> Iterator[Arrays]:
        """Yield the arrays of every frame, in order."""
        return self.read_all(range(self.count))

    def read_all(self, indices: range) -> Iterator[Arrays]:
        """Yield the arrays of the frames `indices`, in order."""
        for index in indices:
            if (kept := self.read(index)) is None:
                raise ConfigError(f"{self.path(index)} is missing or damaged; start the same command again")
            yield kept

    def missing(self) -> list[int]:
        """Return the indices of the frames that are neither kept nor encoded, and say how many are there."""
        left = [index for part in self.parts if not self.part_path(part).exists() for index in part]
        found = [index for index in left if self.read(index) is None]
        if done := self.count - len(found):
            say(f"{done} of {self.count} frames already exist in {self.folder}; rendering the others")
        return found

    @contextmanager
    def resumable(self) -> Iterator[None]:
        """Keep what is there if an error ends the `with` block, and after Ctrl-C say how much it is."""
        try:
            yield
        except BaseException as error:
            encoded = {index for part in self.parts if self.part_path(part).exists() for index in part}
            done = sum(index in encoded or self.path(index).exists() for index in range(self.count))
            if not done:  # nothing to continue
                self.remove()
            elif isinstance(error, KeyboardInterrupt):
                say(f"{done} of {self.count} frames are in {self.folder}; repeat the command to continue")
            raise

    def render(self, render: Callable[[int], Arrays]) -> None:
        """Render the missing frames by `render(index)`, as in `rendered`.

        Raises:
            ConfigError: if a frame cannot be written.
        """
        with self.resumable():
            for _ in self.rendered(self.missing(), render):
                pass

    def rendered(self, missing: Sequence[int], render: Callable[[int], Arrays]) -> Generator[int, None, None]:
        """Render the `missing` frames by `render(index)`, and yield the index of each when it is on the disk.

        A frame is written while the next one is rendered. After the second, say how long the others will take.

        Raises:
            ConfigError: if a frame cannot be written.
        """
        last: tuple[int, Future[None]] | None = None
        with ThreadPoolExecutor(1) as writer:
            for number, index in enumerate(track(missing, "Rendering", total=len(missing)), 1):
                start = time.monotonic()
                arrays = render(index)
                seconds = time.monotonic() - start
                if last is not None:
                    last[1].result()
                    yield last[0]
                last = index, writer.submit(self._keep, index, arrays)
                if number == TIMED and (left := len(missing) - number):
                    say(f"the other {left:,} frames take about {time_text(seconds * left)}")
            if last is not None:
                last[1].result()
                yield last[0]

    def _keep(self, index: int, arrays: Arrays) -> None:
        """Write frame `index`, compressed if all frames that are kept together would be large.

        It is not flushed to the disk: `read` refuses a damaged frame, which is then rendered again.
        """
        together = self.count if self.part_length is None else 3 * self.part_length
        plain = together * sum(values.nbytes for values in arrays.values()) <= MAX_PLAIN
        method = zipfile.ZIP_STORED if plain else zipfile.ZIP_DEFLATED

        def write(file: BinaryIO) -> None:
            with zipfile.ZipFile(file, "w", method, compresslevel=LEVEL) as archive:  # numpy's savez has no level
                for name, values in arrays.items():
                    with archive.open(f"{name}.npy", "w") as part:
                        np.lib.format.write_array(part, values, allow_pickle=False)

        _write(self.path(index), write, flush=False)

    def remove(self) -> None:
        """Remove the frames, and the folder beside the file unless it has frames of another render."""
        shutil.rmtree(self.folder, ignore_errors=True)
        with suppress(OSError):
            self.folder.parent.rmdir()


def open_frames(output: Path, count: int, facts: dict[str, Any], part_length: int | None = None) -> Frames:
    """Return `count` frames for `output`, with the frames of an earlier, stopped run that had the same `facts`.

    `part_length` is as in `Frames`.

    Raises:
        ConfigError: if the folder of the frames cannot be written.
    """
    together = output.with_name(output.name + SUFFIX)
    folder = together / key_of(facts)
    if others := [path for path in sorted(together.glob("*")) if path != folder]:
        say(f"{others[0]} has frames of another render (its run, cameras or flags differ); they are kept")
    write_file(folder / FACTS, (json.dumps(facts, indent=2) + "\n").encode())
    return Frames(folder, count, part_length)


def key_of(facts: dict[str, Any]) -> str:
    """Return a key of 16 hexadecimal digits for plain data `facts`."""
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]


def hash_of_file(path: Path) -> str:
    """Return the SHA-256 of the content of the file `path`."""
    found = hashlib.sha256()
    with path.open("rb") as file:
        while piece := file.read(PIECE):
            found.update(piece)
    return found.hexdigest()


def hash_of_tensors(*tensors: Tensor | None) -> str:
    """Return a SHA-256 of the values, types and shapes of `tensors`, which may be None."""
    found = hashlib.sha256()
    for tensor in tensors:
        if tensor is not None:
            found.update(f"{tensor.dtype} {tuple(tensor.shape)}".encode())
            found.update(tensor.detach().cpu().contiguous().numpy().tobytes())
        found.update(b";")
    return found.hexdigest()


def write_file(path: Path, content: bytes) -> None:
    """Write `content` to the file `path` atomically; its folder is created if missing.

    Raises:
        ConfigError: if it cannot be written.
    """
    _write(path, lambda file: file.write(content))


def _write(path: Path, write: Callable[[BinaryIO], object], flush: bool = True) -> None:
    """Create the folder of a file, call `write_atomically`, and convert errors of the system."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, write, flush)
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        remedy = "free some space, and repeat the command" if full else "use another path"
        raise ConfigError(f"cannot write {path}: {error.strerror or error}; {remedy}") from error

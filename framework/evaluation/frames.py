"""Frames of a long render, kept on disk until its files are written, so that a stopped render goes on.

They lie in FILE.frames/KEY/ beside the file or folder that is rendered. The key is a hash of everything that the frames
depend on, so that frames of one command are never taken for those of another. What it was made of is in render.json.
"""

from __future__ import annotations

import hashlib
import io
import json
import shutil
import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from nerfloom.base.atomic import write_atomically
from nerfloom.base.console import say, track
from nerfloom.base.errors import ConfigError
from nerfloom.evaluation.outputs import Arrays

FACTS = "render.json"
"""Name of the file that says what was rendered."""
SUFFIX = ".frames"
"""Added to the name of what is rendered, the name of the folder of its frames."""
PIECE = 2**24
"""Bytes of a file that are read and hashed at a time."""


@dataclass(frozen=True)
class Frames:
    """Frames on disk."""

    folder: Path
    """Folder of these frames alone."""
    count: int
    """Number of frames of the whole render."""

    def path(self, index: int) -> Path:
        """Return the path of frame `index`."""
        return self.folder / f"{index:06d}.npz"

    def read(self, index: int) -> Arrays | None:
        """Return what is kept of frame `index`; None if it is missing or damaged."""
        try:
            with np.load(self.path(index), allow_pickle=False) as content:
                return {name: content[name] for name in content.files}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None

    def __iter__(self) -> Iterator[Arrays]:
        """Yield what is kept of every frame, in order."""
        for index in range(self.count):
            if (kept := self.read(index)) is None:
                raise ConfigError(f"{self.path(index)} is missing or damaged; start the same command again")
            yield kept

    def render(self, render: Callable[[int], Arrays]) -> None:
        """Render the frames that are not there yet.

        Args:
            render: function from a frame's index to what is kept of it.

        Raises:
            ConfigError: if a frame cannot be written.
        """
        missing = [index for index in range(self.count) if self.read(index) is None]
        done = self.count - len(missing)
        if done:
            say(f"{done} of {self.count} frames are there already, in {self.folder}; going on with the others")
        try:
            for index in track(missing, "Rendering", total=len(missing)):
                content = io.BytesIO()
                arrays: dict[str, Any] = dict(render(index))
                np.savez_compressed(content, **arrays)
                write_file(self.path(index), content.getvalue())
                done += 1
        except BaseException as error:
            if not done:  # nothing to go on with
                self.remove()
            elif isinstance(error, KeyboardInterrupt):
                say(f"{done} of {self.count} frames are in {self.folder}; the same command goes on with them")
            raise

    def remove(self) -> None:
        """Remove the frames, and the folder beside the file unless it holds frames of another render."""
        shutil.rmtree(self.folder, ignore_errors=True)
        with suppress(OSError):
            self.folder.parent.rmdir()


def open_frames(output: Path, count: int, facts: dict[str, Any]) -> Frames:
    """Return the frames for a file or folder, those of an earlier, stopped start of the same command included.

    Args:
        output: file or folder that is rendered.
        count: number of frames.
        facts: plain data; everything that the frames depend on.

    Raises:
        ConfigError: if the folder of the frames cannot be written.
    """
    together = output.with_name(output.name + SUFFIX)
    folder = together / key_of(facts)
    if others := [path for path in sorted(together.glob("*")) if path != folder]:
        say(f"{others[0]} holds frames of another render (its run, cameras or flags differ); it is left as it is")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"cannot write {folder}: {error.strerror or error}; name another place") from error
    write_file(folder / FACTS, (json.dumps(facts, indent=2) + "\n").encode())
    return Frames(folder, count)


def key_of(facts: dict[str, Any]) -> str:
    """Return 16 hexadecimal digits that stand for plain data, `facts`."""
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]


def hash_of_file(path: Path) -> str:
    """Return the SHA-256 of the content of the file `path`."""
    found = hashlib.sha256()
    with path.open("rb") as file:
        while piece := file.read(PIECE):
            found.update(piece)
    return found.hexdigest()


def hash_of_tensors(*tensors: Tensor | None) -> str:
    """Return a SHA-256 of the values, types and shapes of `tensors`, any of which may be None."""
    found = hashlib.sha256()
    for tensor in tensors:
        if tensor is not None:
            found.update(f"{tensor.dtype} {tuple(tensor.shape)}".encode())
            found.update(tensor.detach().cpu().contiguous().numpy().tobytes())
        found.update(b";")
    return found.hexdigest()


def write_file(path: Path, content: bytes) -> None:
    """Write `content` to the file `path`, as a whole or not at all.

    Raises:
        ConfigError: if it cannot be written.
    """
    try:
        write_atomically(path, lambda file: file.write(content))
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror or error}") from error

"""Checkpoints of tensors and plain data, written atomically, so that a killed process leaves no incomplete file.

A file is PyTorch's archive followed by a seal, the archive's SHA-256 hash: PyTorch itself does not check the bytes of
tensors.
"""

from __future__ import annotations

import hashlib
import os
import re
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO

import torch
from torch.torch_version import TorchVersion

from nerfloom.base.archives import uncompressed_size
from nerfloom.base.atomic import write_atomically
from nerfloom.base.console import say
from nerfloom.base.errors import CheckpointError
from nerfloom.training.run_path import CHECKPOINTS

FOLDER = CHECKPOINTS
"""Name of the checkpoints' folder in a run's folder."""
FORMAT = 2
"""Value of a checkpoint's `format`."""
SEAL = b"\nsha256:"
"""Bytes before the hexadecimal hash at the end of the file."""
PIECE = 2**24
"""Bytes to read and hash at a time."""
MAPPED_SIZE = 2**30
"""Minimum size of a file that is mapped into memory on a CPU, instead of being read as a whole."""
SAFE_TORCH = "2.10"
"""First version of PyTorch with a `weights_only` reader that is not known to execute code (CVE-2026-24747)."""
_NAME = re.compile(r"step-(\d{9})\.ckpt")


class _Hashed:
    """A file that torch writes to, and the hash of its content.

    Torch does not expect errors while it writes. So the first one is kept, and the rest is not written.

    Args:
        file: the file.
        written: called after each tensor.
    """

    def __init__(self, file: BinaryIO, written: Callable[[], None]) -> None:
        self.file, self.written, self.digest = file, written, hashlib.sha256()
        self.error: OSError | None = None

    def write(self, content: bytes) -> int:
        if self.error is None:
            try:
                self.file.write(content)
            except OSError as error:
                self.error = error
            self.digest.update(content)
            self.written()
        return len(content)

    def flush(self) -> None:
        """Do nothing; `write_atomically` flushes the file."""


def save_checkpoint(
    folder: Path,
    step: int,
    state: dict[str, Any],
    keep_all: bool,
    before: int | None = None,
    written: Callable[[], None] = lambda: None,
) -> Path:
    """Write a checkpoint; then, unless all are kept, remove all but one checkpoint of earlier steps.

    Checkpoints of later steps are damaged, since the run continued from an earlier one. They stay and do not count.

    Args:
        folder: folder of the checkpoints, created if missing.
        step: number of training steps done, which is in the file's name.
        state: tensors and plain data.
        keep_all: whether all checkpoints are kept.
        before: step of the earlier checkpoint to keep: the run last wrote it or continued from it. If None or missing,
            the checkpoint of the last step before `step` is kept.
        written: called after each tensor is written, such as `Tables.release`.

    Returns:
        The checkpoint's path.

    Raises:
        CheckpointError: if the file cannot be written; older checkpoints are then unchanged.
    """
    path = checkpoint_path(folder, step)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(path, lambda file: _write(file, {"format": FORMAT, **state}, written))
    except (OSError, RuntimeError) as error:
        raise CheckpointError(f"cannot write {path}: {error}; earlier checkpoints are unchanged") from error
    for remnant in folder.glob(".step-*.ckpt.*.tmp"):  # from a process killed while writing
        remnant.unlink(missing_ok=True)
    earlier = [other for other in list_checkpoints(folder) if other.name < path.name]
    previous = None if before is None else checkpoint_path(folder, before)
    kept = previous if previous in earlier else next(reversed(earlier), None)
    for old in earlier:
        if not keep_all and old != kept:
            old.unlink(missing_ok=True)
    return path


def _write(file: BinaryIO, content: dict[str, Any], written: Callable[[], None]) -> None:
    """Write the content of a checkpoint and its seal, without a copy of the tensors in memory."""
    hashed: Any = _Hashed(file, written)
    torch.save(content, hashed)
    if hashed.error is not None:
        raise hashed.error
    file.write(SEAL + hashed.digest.hexdigest().encode())


@cache
def _warn_of(version: str) -> None:
    say(
        f"torch {version} can execute code from a manipulated checkpoint (CVE-2026-24747): "
        f"do not load checkpoints from strangers, or upgrade torch to {SAFE_TORCH} or newer"
    )


def checkpoint_path(folder: Path, step: int) -> Path:
    """Return the path of the checkpoint of a training `step` in a `folder`."""
    return folder / f"step-{step:09d}.ckpt"


def list_checkpoints(folder: Path) -> list[Path]:
    """Return the checkpoints in `folder`, earliest step first."""
    return sorted(path for path in folder.glob("step-*.ckpt") if _NAME.fullmatch(path.name))


def load_checkpoint(path: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read a checkpoint without executing code in it (`weights_only`), if PyTorch is `SAFE_TORCH` or newer.

    Args:
        path: file to read.
        device: device of the tensors.

    Returns:
        The content, tensors and plain data.

    Raises:
        CheckpointError: if the file is missing, damaged, or not a checkpoint of this version.
    """
    if TorchVersion(torch.__version__) < SAFE_TORCH:
        _warn_of(torch.__version__)
    try:
        sealed = _is_sealed(path)
        if uncompressed_size(path) > path.stat().st_size:  # torch writes uncompressed, but reads compressed
            raise CheckpointError(f"{path} is damaged: its uncompressed size is larger than the file")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch warns of foreign pickles, which are refused below
            state = torch.load(path, map_location=device, weights_only=True, mmap=_is_mapped(path, device))
    except CheckpointError:
        raise
    except FileNotFoundError as error:
        raise CheckpointError(f"there is no checkpoint {path}") from error
    except Exception as error:  # torch raises RuntimeError, UnpicklingError, EOFError, KeyError, OSError and more
        raise CheckpointError(f"{path} is damaged or not a checkpoint of nerfloom") from error
    number = state.get("format") if isinstance(state, dict) else None
    if not isinstance(number, int) or number != FORMAT or "model" not in state:
        raise CheckpointError(f"{path} is not a checkpoint of this version of nerfloom (format {FORMAT})")
    if not sealed:
        raise CheckpointError(f"{path} is damaged: its seal is missing")
    return state


def _is_mapped(path: Path, device: torch.device | str) -> bool:
    """Return whether a file is mapped. Windows could not remove it later."""
    return os.name == "posix" and torch.device(device).type == "cpu" and path.stat().st_size >= MAPPED_SIZE


def _is_sealed(path: Path) -> bool:
    """Return whether a file ends with a seal; raise CheckpointError if the seal does not match the bytes before it."""
    length = len(SEAL) + 2 * hashlib.sha256().digest_size
    with path.open("rb") as file:
        remaining = max(file.seek(0, os.SEEK_END) - length, 0)
        file.seek(remaining)
        seal = file.read()
        if not seal.startswith(SEAL):
            return False
        file.seek(0)
        digest = hashlib.sha256()
        while remaining:
            piece = file.read(min(remaining, PIECE))
            digest.update(piece)
            remaining -= len(piece)
    if seal != SEAL + digest.hexdigest().encode():
        raise CheckpointError(f"{path} is damaged: its content does not match its seal")
    return True


def load_newest(folder: Path, device: torch.device | str = "cpu") -> dict[str, Any] | None:
    """Return the content of the newest readable checkpoint in a `folder`, on `device`; None if it has none.

    Raises:
        CheckpointError: if there are checkpoints, but none can be read.
    """
    newest = find_newest(folder, device)
    return None if newest is None else newest[1]


def find_newest(folder: Path, device: torch.device | str = "cpu") -> tuple[Path, dict[str, Any]] | None:
    """Return the newest readable checkpoint in a folder; unreadable ones are reported and skipped.

    Args:
        folder: folder of the checkpoints.
        device: device of the tensors.

    Returns:
        The checkpoint's path and its content; None if the folder has no checkpoint.

    Raises:
        CheckpointError: if there are checkpoints, but none can be read.
    """
    paths = list_checkpoints(folder)
    for path in reversed(paths):
        try:
            return path, load_checkpoint(path, device)
        except CheckpointError as error:
            say(f"{error}; trying the previous one")
    if paths:
        raise CheckpointError(f"none of the {len(paths)} checkpoints in {folder} can be read")
    return None

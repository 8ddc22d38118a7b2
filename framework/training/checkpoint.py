"""Checkpoints: tensors and plain data only, written so that a killed process never leaves half of one.

A file is what torch writes and a seal, which is a hash of it: torch does not look whether a tensor's bytes are still
those that were written. Before there were seals, `format` was 1.
"""

from __future__ import annotations

import hashlib
import io
import os
import re
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO

import torch
from torch.torch_version import TorchVersion

from framework.base.archives import uncompressed_size
from framework.base.console import say
from framework.base.errors import CheckpointError

FOLDER = "nerfstudio_models"
UNSEALED, SEALED = 1, 2
"""What `format` may be."""
SEAL = b"\nsha256:"
"""What stands before the hash, which ends the file."""
PIECE = 2**24
"""Bytes that are hashed at once."""
SAFE_TORCH = "2.10"
"""The first whose reader cannot be made to run code by a checkpoint, as far as is known (CVE-2026-24747)."""
_NAME = re.compile(r"step-(\d{9})\.ckpt")


def write_atomically(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Call `write(file)` on a temporary file beside `path`, flush it to disk and rename it.

    Raises: OSError as it comes; `path` is then as it was, and no temporary file is left.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _flush_folder(path.parent)


def _flush_folder(folder: Path) -> None:
    """Let the names in a folder reach the disk: the new one before older files are removed."""
    with suppress(OSError):  # Windows opens no folders, and some file systems flush none
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)


def save_checkpoint(folder: Path, step: int, state: dict[str, Any], keep_all: bool, before: int | None = None) -> Path:
    """Write `state` as step-%09d.ckpt; then, unless `keep_all`, remove all before it but one.

    Later ones stay: they were damaged, or the run would not have gone on from an earlier one, and push nothing out.

    Args:
        before: the step of the one that stays, which the run has saved, or gone on from, last: a later one is damaged.
            If there is none of that step, the last before `step` stays.
    Raises: CheckpointError where it cannot be written; older checkpoints are untouched then.
    """
    path = _path(folder, step)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        content = io.BytesIO()  # written by torch itself, a full disk is reported as "unexpected pos"
        torch.save({"format": SEALED, **state}, content)
        content.seek(0, os.SEEK_END)
        content.write(SEAL + hashlib.sha256(content.getbuffer()).hexdigest().encode())
        write_atomically(path, lambda file: file.write(content.getbuffer()))
    except (OSError, RuntimeError) as error:
        raise CheckpointError(f"cannot write {path}: {error}; earlier checkpoints stand") from error
    for remnant in folder.glob(".step-*.ckpt.*.tmp"):  # of a process that was killed while writing
        remnant.unlink(missing_ok=True)
    earlier = [other for other in list_checkpoints(folder) if other.name < path.name]
    known = None if before is None else _path(folder, before)
    staying = known if known in earlier else next(reversed(earlier), None)
    for old in earlier:
        if not keep_all and old != staying:
            old.unlink(missing_ok=True)
    return path


@cache
def _warn_of(version: str) -> None:
    say(
        f"torch {version} can be made to run code by a checkpoint that was made for that (CVE-2026-24747): "
        f"load none from strangers, or upgrade torch to {SAFE_TORCH} or newer"
    )


def _path(folder: Path, step: int) -> Path:
    return folder / f"step-{step:09d}.ckpt"


def list_checkpoints(folder: Path) -> list[Path]:
    """Checkpoints in a folder, oldest first."""
    return sorted(path for path in folder.glob("step-*.ckpt") if _NAME.fullmatch(path.name))


def load_checkpoint(path: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read a checkpoint. Nothing in it is executed (`weights_only`), unless torch is older than `SAFE_TORCH`.

    Raises: CheckpointError where it is missing, not as it was written, or not one of ours.
    """
    if TorchVersion(torch.__version__) < SAFE_TORCH:
        _warn_of(torch.__version__)
    try:
        sealed = _is_sealed(path)
        if uncompressed_size(path) > path.stat().st_size:  # torch compresses nothing, but would unfold what is
            raise CheckpointError(f"{path} is damaged: it would unfold to more than it holds")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch's doubts about foreign pickles; they are refused below
            state = torch.load(path, map_location=device, weights_only=True)
    except CheckpointError:
        raise
    except FileNotFoundError as error:
        raise CheckpointError(f"there is no checkpoint {path}") from error
    except Exception as error:  # torch raises RuntimeError, UnpicklingError, EOFError, KeyError, OSError and more
        raise CheckpointError(f"{path} is damaged or not a checkpoint of nerfloom") from error
    number = state.get("format") if isinstance(state, dict) else None
    if not isinstance(number, int) or number not in (UNSEALED, SEALED) or "model" not in state:
        raise CheckpointError(f"{path} is not a checkpoint of this version of nerfloom (format {SEALED})")
    if number == SEALED and not sealed:
        raise CheckpointError(f"{path} is damaged: its seal is missing")
    return state


def _is_sealed(path: Path) -> bool:
    """Whether a file ends with a seal.

    Raises: CheckpointError where it is not the seal of what stands before it; OSError as it comes.
    """
    length = len(SEAL) + 2 * hashlib.sha256().digest_size
    with path.open("rb") as file:
        left = max(file.seek(0, os.SEEK_END) - length, 0)
        file.seek(left)
        seal = file.read()
        if not seal.startswith(SEAL):
            return False
        file.seek(0)
        digest = hashlib.sha256()
        while left:
            piece = file.read(min(left, PIECE))
            digest.update(piece)
            left -= len(piece)
    if seal != SEAL + digest.hexdigest().encode():
        raise CheckpointError(f"{path} is damaged: it is not as it was written")
    return True


def load_newest(folder: Path, device: torch.device | str = "cpu") -> dict[str, Any] | None:
    """The newest readable checkpoint of a folder, or None where the folder has none: see `find_newest`."""
    found = find_newest(folder, device)
    return None if found is None else found[1]


def find_newest(folder: Path, device: torch.device | str = "cpu") -> tuple[Path, dict[str, Any]] | None:
    """The newest readable checkpoint of a folder and its content, or None where the folder has none.

    A damaged one is reported and the one before it is taken.

    Raises: CheckpointError where there are checkpoints, but none can be read.
    """
    paths = list_checkpoints(folder)
    for path in reversed(paths):
        try:
            return path, load_checkpoint(path, device)
        except CheckpointError as error:
            say(f"{error}; trying the one before")
    if paths:
        raise CheckpointError(f"none of the {len(paths)} checkpoints in {folder} can be read")
    return None

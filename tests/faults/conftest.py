"""Disks that are small, or may not be written to."""

import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

Disk = Callable[[str], None]
"""Mounts the folder `disk` of the test's anew, with options such as size=300k or ro."""


def mount(folder: Path, options: str) -> bool:
    """Whether this process may mount a file system in memory."""
    try:
        command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
        return subprocess.run(command, capture_output=True, check=False).returncode == 0
    except OSError:
        return False


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Disk]:
    """A disk of its own, `tmp_path / "disk"`; tests are skipped where none may be mounted."""
    folder = tmp_path / "disk"
    folder.mkdir()
    if not mount(folder, "size=64m"):
        pytest.skip("needs the right to mount a file system: root, outside of most containers")

    def change(options: str) -> None:
        subprocess.run(["mount", "-o", f"remount,{options}", str(folder)], capture_output=True, check=True)

    yield change
    subprocess.run(["umount", "-l", str(folder)], capture_output=True, check=True)


@pytest.fixture
def read_only(tmp_path: Path) -> Iterator[Callable[[Path], None]]:
    """Takes the right to write to a folder away, until the test ends."""
    if os.name != "posix" or os.geteuid() == 0:
        pytest.skip("root may write to any folder")
    changed = []

    def take(folder: Path) -> None:
        changed.append(folder)
        folder.chmod(0o555)

    yield take
    for folder in changed:
        folder.chmod(0o755)

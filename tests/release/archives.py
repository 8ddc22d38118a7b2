"""Content of the two distributions: all needed files, no others, and within a size."""

import ast
import re
import subprocess
import tarfile
import zipfile
from email import message_from_bytes
from email.message import Message
from pathlib import Path

from nerfloom.kernels.native import NEEDS
from tests.release.problem import Problem
from tests.release.sources import ROOT, version

PACKAGES = ("framework", "methods", "dataparsers")
MAX_WHEEL = 6_000_000
"""Maximum size of the wheel, bytes. The kernels of five instruction sets take most of it."""
MAX_SDIST = 3_000_000
"""Bytes."""
DATA = (".png", ".jpg", ".jpeg", ".gif", ".exr", ".mp4", ".npy", ".npz", ".ply", ".spz", ".ckpt", ".pt", ".zip")
"""Suffixes of pictures, data and checkpoints; none belongs in a distribution."""
LIBRARIES = (".so", ".dylib", ".dll")


def tracked() -> list[str]:
    """Paths of the packages' files that git tracks."""
    listed = subprocess.run(["git", "ls-files", "--", *PACKAGES], cwd=ROOT, capture_output=True, text=True, check=True)
    return listed.stdout.splitlines()


def installed(path: str) -> str:
    """The place in site-packages of a file of the repository."""
    return "nerfloom/" + path.removeprefix("framework/")


def check_wheel(wheel: Path) -> str:
    """Check names, metadata, licence, kernels and size of a wheel."""
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        folder = f"nerfloom-{version()}.dist-info"
        metadata = message_from_bytes(archive.read(f"{folder}/METADATA"))
    if missing := sorted({installed(path) for path in tracked()} - set(names)):
        raise Problem(f"the wheel lacks {', '.join(missing[:5])} ({len(missing)} files)")
    strange = [name for name in names if name.split("/")[0] not in ("nerfloom", folder)]
    data = [name for name in names if name.lower().endswith(DATA)]
    if strange or data:
        raise Problem(f"the wheel holds {', '.join([*strange, *data][:5])}, which do not belong into it")
    if f"{folder}/licenses/LICENSE" not in names:
        raise Problem("the wheel lacks the licence")
    libraries = [Path(name) for name in names if name.endswith(LIBRARIES)]
    if not libraries or any(path.parent.as_posix() != "nerfloom/kernels/lib" for path in libraries):
        raise Problem(f"the wheel's libraries are {libraries}; only the kernels' libraries are expected")
    kinds = {path.stem for path in libraries}
    if re.search(r"linux.*x86_64", wheel.name) and kinds != set(NEEDS):
        raise Problem(f"the wheel lacks the kernels for {', '.join(sorted(set(NEEDS) - kinds))}: is the compiler old?")
    if not re.fullmatch(rf"nerfloom-{re.escape(version())}-py3-none-(?!any)\w+\.whl", wheel.name):
        raise Problem(f"{wheel.name} is not for any Python on one platform")
    check_declared(metadata)
    check_size(wheel, MAX_WHEEL)
    built = ", ".join(sorted(kinds))
    return f"wheel: {len(names)} files, {wheel.stat().st_size / 1e6:.2f} MB, kernels {built}; no data, licence included"


def check_declared(metadata: Message) -> None:
    """Check that the metadata agrees with pyproject.toml."""
    pyproject = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    required = {re.sub(r"\s", "", line) for line in metadata.get_all("Requires-Dist", []) if "extra ==" not in line}
    declared = re.search(r"^dependencies = (\[.*?^\])", pyproject, re.MULTILINE | re.DOTALL)
    pythons = re.search(r'^requires-python = "(.*)"$', pyproject, re.MULTILINE)
    if declared is None or pythons is None:
        raise Problem("pyproject.toml has no dependencies, or no requires-python")
    if required != {re.sub(r"\s", "", line) for line in ast.literal_eval(declared[1])}:
        raise Problem(f"the wheel requires {sorted(required)}, unlike pyproject.toml")
    for field, value in (("Version", version()), ("Requires-Python", pythons[1])):
        if metadata[field] != value:
            raise Problem(f"the wheel's {field} is {metadata[field]}, not {value}")


def check_sdist(sdist: Path) -> str:
    """Check that a source distribution holds all that a build needs, and neither tests nor data."""
    with tarfile.open(sdist) as archive:
        names = [Path(*Path(member.name).parts[1:]).as_posix() for member in archive.getmembers() if member.isfile()]
    needed = [*tracked(), "pyproject.toml", "setup.py", "README.md", "LICENSE", "constraints.txt", "CITATION.cff"]
    if missing := sorted(set(needed) - set(names)):
        raise Problem(f"the sdist lacks {', '.join(missing[:5])} ({len(missing)} files)")
    suffixes = (*DATA, *LIBRARIES)
    unwanted = [name for name in names if name.startswith(("tests/", "docs/")) or name.lower().endswith(suffixes)]
    if unwanted:
        raise Problem(f"the sdist holds {', '.join(unwanted[:5])} ({len(unwanted)} files), which do not belong into it")
    check_size(sdist, MAX_SDIST)
    return f"sdist: {len(names)} files, {sdist.stat().st_size / 1e6:.2f} MB; no tests, no data, no libraries"


def check_size(file: Path, most: int) -> None:
    if file.stat().st_size > most:
        raise Problem(f"{file.name} has {file.stat().st_size} bytes; {most} at most are expected")

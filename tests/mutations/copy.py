"""A copy of the repository, with an environment of its own in which nothing else is installed as nerfloom.

The tests start commands and interpreters in other folders and with other paths. An environment that an installed or
editable nerfloom is part of would sooner or later run the original there, and a bug in the copy would go unnoticed for
the wrong reason.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
from dataclasses import dataclass
from pathlib import Path

from tests.mutations.plugin import CONTEXT

ROOT = Path(__file__).parents[2]
PACKAGES = ("framework", "methods", "dataparsers")
LEFT_OUT = shutil.ignore_patterns(
    ".git", ".venv", "__pycache__", ".*_cache", ".hypothesis", "outputs", "build", "dist", "shared"
)


class NotTheCopy(Exception):
    """What is imported is not the copy."""


@dataclass(frozen=True)
class Copy:
    """A tree that may be changed."""

    root: Path
    python: Path
    """An interpreter that imports the tree, and all else from where this one does."""

    def environment(self, **more: str) -> dict[str, str]:
        """For processes that test the tree."""
        kept = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
        path = os.pathsep.join([str(self.python.parent), kept.get("PATH", "")])
        return {**kept, "PATH": path, **more}

    def check(self) -> None:
        """Raises: NotTheCopy where an interpreter that is started elsewhere imports another tree."""
        code = "from pathlib import Path as P; import nerfloom as n, nerfloom.methods as m, nerfloom.dataparsers as d; "
        code += "print(*(P(module.__path__[0]).resolve() for module in (n, m, d)), sep='\\n')"
        words = [str(self.python), "-I", "-c", code]
        done = subprocess.run(words, cwd=self.python.parent, env=self.environment(), capture_output=True, text=True)
        wanted = [str((self.root / package).resolve()) for package in PACKAGES]
        if done.stdout.splitlines() != wanted:
            raise NotTheCopy(f"{self.python} imports {done.stdout.split()} for {wanted}: {done.stderr}")


def make_copy(folder: Path) -> Copy:
    """The repository as it is now, with its compiled kernels, in `folder`; and its environment beside it.

    Raises: NotTheCopy where the environment does not import the copy.
    """
    root = folder / "tree"
    shutil.copytree(ROOT, root, ignore=LEFT_OUT, symlinks=True)
    environment = folder / "environment"
    venv.create(environment, symlinks=True)
    site = Path(sysconfig.get_path("purelib", vars={"base": str(environment), "platbase": str(environment)}))
    # Lines of a .pth are added to the path as they are: the original's own .pth files, which make it importable,
    # are not read.
    original = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
    shutil.copy(Path(__file__).with_name("startup.py"), site / "mutations_startup.py")
    records = f"import os; os.environ.get({CONTEXT!r}) and __import__('mutations_startup')"
    package = environment / "links" / "nerfloom"
    package.mkdir(parents=True)
    for part in (*(root / "framework").iterdir(), root / "methods", root / "dataparsers"):
        (package / part.name).symlink_to(part)
    (site / "copy.pth").write_text("\n".join([str(package.parent), str(root), *original, records]) + "\n")
    scripts = Path(sys.executable).parent
    for script in scripts.glob("ns-*"):
        text = re.sub(r"^#!.*python[0-9.]*", f"#!{environment / 'bin' / 'python'}", script.read_text(), count=1)
        (environment / "bin" / script.name).write_text(text)
        (environment / "bin" / script.name).chmod(0o755)
    copy = Copy(root, environment / "bin" / "python")
    copy.check()
    return copy

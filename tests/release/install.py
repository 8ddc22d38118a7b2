"""A distribution installed into an environment of its own, and used there.

Dependencies come from the environment that runs the check: they are found last on the path, so that nothing is
downloaded, and no other torch gets in.
"""

import json
import os
import re
import sys
import venv
from dataclasses import dataclass
from pathlib import Path

from tests.release.build import run
from tests.release.problem import Problem

BIN = "Scripts" if os.name == "nt" else "bin"
NO_COMPILER = {"CC": "false", "CXX": "false"}


@dataclass(frozen=True)
class Environment:
    """A virtual environment with a wheel or an sdist, which is built there.

    Args:
        folder: folder of the environment.
        distribution: file to install.
    """

    folder: Path
    distribution: Path

    @property
    def python(self) -> Path:
        return self.folder / BIN / "python"

    def install(self, **variables: str) -> str:
        """Create the environment and install the distribution; return pip's output."""
        venv.EnvBuilder(symlinks=os.name != "nt", clear=True).create(self.folder)
        pip = [sys.executable, "-m", "pip", "--isolated", "--disable-pip-version-check", "--no-cache-dir"]
        words = [*pip, "--python", self.python, "install", "-v", "--no-index", "--no-deps", "--no-build-isolation"]
        purelib = "import sysconfig; print(sysconfig.get_path('purelib'))"
        modules = Path(run([self.python, "-c", purelib], self.folder).strip())
        # A path in a .pth file comes last, and .pth files in it are not read: an editable nerfloom there is not seen.
        paths = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
        (modules / "dependencies.pth").write_text("\n".join(paths) + "\n")
        return run([*words, self.distribution], self.folder, **variables)

    def use(self, data: Path | None, limit: str) -> str:
        """Install and train; a wheel needs no compiler."""
        is_wheel = self.distribution.suffix == ".whl"
        self.install(**(NO_COMPILER if is_wheel else {}))
        kernels = self.kernels()
        if kernels == "reference":
            raise Problem(f"{self.distribution.name}: its kernels are not used")
        return f"{kernels} kernels, {self.train(data, limit)}"

    def kernels(self) -> str:
        """The variant of the kernels that the installed package uses."""
        said = run([self.folder / BIN / "ns-train", "--version", "--environment"], self.folder, **NO_COMPILER)
        home = re.search(r"^nerfloom +\S+ from (.+?)(, commit .*)?$", said, re.MULTILINE)
        if home is None or not Path(home[1]).is_relative_to(self.folder):
            raise Problem(f"not the installed package runs, but the one of {home and home[1]}")
        found = re.search(r"^kernels +(\w+) on the CPU", said, re.MULTILINE)
        if found is None:
            raise Problem(f"ns-train --version --environment does not say which kernels run:\n{said}")
        return found[1]

    def train(self, data: Path | None, limit: str) -> str:
        """Train instant-ngp up to the flag `limit`; return the PSNR of a few held-out images."""
        words = ["instant-ngp", *(["--data", data] if data else []), *limit.split(), "--max-eval-images", 4]
        words += ["--vis", "none", "--timestamp", "t", "--output-dir", self.folder / "outputs"]
        own = {"NERFLOOM_CACHE": str(self.folder / "cache"), **NO_COMPILER}
        run([self.folder / BIN / "ns-train", *words], self.folder, **own)
        (result,) = (self.folder / "outputs").rglob("eval.json")
        psnr = json.loads(result.read_text())["results"]["psnr"]
        if not psnr > 15:
            raise Problem(f"{self.distribution.name}: trained with {limit}, the PSNR is {psnr:.2f} dB")
        return f"instant-ngp {psnr:.2f} dB on {data.name if data else 'the embedded scene'} with {limit}"


def check_without_compiler(folder: Path, sdist: Path) -> str:
    """Install a source distribution where there is no compiler: it works, without kernels, and says so."""
    environment = Environment(folder, sdist)
    said = environment.install(**NO_COMPILER)
    if "CPU kernels could not be built" not in said:
        raise Problem("without a compiler, the installation does not say that the kernels could not be built")
    if environment.kernels() != "reference":
        raise Problem("without a compiler, kernels came from somewhere else")
    return "installs, says that the kernels could not be built, and runs on torch"

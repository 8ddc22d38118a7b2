"""A method of another package, as its users have it: nerfloom's wheel and the example's in an environment of their own.

Dependencies come from the tests' environment, so nothing is downloaded.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import venv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from nerfloom.registry import VARIABLES
from tests.patience import PATIENCE

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "plugin-method"
PACKAGES = ("framework", "methods", "dataparsers")
SOURCES = ("pyproject.toml", "setup.py", "README.md", "LICENSE", *PACKAGES)
BUILT = shutil.ignore_patterns("__pycache__", "lib", "build", "*.egg-info")
SMALL = "--max-resolution 32 --grid-resolution 16 --num-steps 64 --samples-per-batch 4096"
TINY_NGP = f"{SMALL} --num-levels 4 --log2-table-size 12"
SCENE = "--size 24 --num-train 8"
BIN = "Scripts" if os.name == "nt" else "bin"
LEADS_ASTRAY = ("PYTHONPATH", "PYTHONHOME", *VARIABLES.values())
"""Variables that lead Python to the sources, or Nerfloom to methods of the person who runs the tests."""


@dataclass(frozen=True)
class Installed:
    """A virtual environment with both packages."""

    folder: Path
    modules: Path
    """Where its own packages are."""

    @property
    def python(self) -> Path:
        return self.folder / BIN / "python"

    def run(self, command: str, *arguments: object) -> subprocess.CompletedProcess[str]:
        """Run one of its commands, far from the sources."""
        return run([self.folder / BIN / command, *arguments], self.folder)

    def train(self, method: str, flags: str, timestamp: str) -> tuple[subprocess.CompletedProcess[str], Path]:
        """Train twenty steps on the embedded scene; return the output, and the run's folder."""
        limits = f"--max-num-iterations 20 --max-eval-images 2 --vis none --timestamp {timestamp}"
        words = f"{flags} {limits} --output-dir {self.folder / 'outputs'} procedural {SCENE}".split()
        return self.run("ns-train", method, *words), self.folder / "outputs" / "procedural" / method / timestamp


def run(words: list[object], folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a program in a folder, in an environment without misleading variables."""
    environment = {key: value for key, value in os.environ.items() if key not in LEADS_ASTRAY}
    environment["NERFLOOM_CACHE"] = str(folder / "cache")
    return subprocess.run(
        list(map(str, words)), capture_output=True, text=True, cwd=folder, env=environment, timeout=PATIENCE
    )


def checked(words: list[object], folder: Path) -> str:
    """The output of a program that must succeed."""
    done = run(words, folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """Both wheels, built from copies of the sources and installed; the dependencies come after them on the path."""
    pytest.importorskip("setuptools", minversion="77")
    pytest.importorskip("pip", minversion="22.3")
    folder = tmp_path_factory.mktemp("installed")
    for name in SOURCES:
        source, copy = ROOT / name, folder / "sources" / name
        copy.parent.mkdir(exist_ok=True)
        shutil.copytree(source, copy, ignore=BUILT) if source.is_dir() else shutil.copy(source, copy)
    shutil.copytree(EXAMPLE, folder / "example", ignore=BUILT)
    # Isolated, pip follows no settings of the person who runs the tests, such as one to install into their home.
    pip: list[object] = [sys.executable, "-m", "pip", "--isolated", "--disable-pip-version-check", "--no-cache-dir"]
    build = [*pip, "wheel", "--no-index", "--no-deps", "--no-build-isolation", "--wheel-dir", folder / "wheels"]
    checked([*build, folder / "sources", folder / "example"], folder)
    venv.EnvBuilder(symlinks=os.name != "nt").create(folder / "venv")
    python = folder / "venv" / BIN / "python"
    wheels = sorted((folder / "wheels").glob("*.whl"))
    assert len(wheels) == 2
    checked([*pip, "--python", python, "install", "--no-index", "--no-deps", *wheels], folder)
    purelib = "import sysconfig; print(sysconfig.get_path('purelib'))"
    modules = Path(checked([python, "-c", purelib], folder).strip())
    # A path in a .pth file comes last, and .pth files in it are not read: an editable nerfloom there is not seen.
    dependencies = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
    (modules / "dependencies.pth").write_text("\n".join(dependencies) + "\n")
    return Installed(folder / "venv", modules)


@pytest.fixture
def broken(installed: Installed) -> Iterator[Installed]:
    """The same, while the example cannot be imported."""
    module = installed.modules / "dense_grid.py"
    sound = module.read_text()
    module.write_text('"""Never loads."""\n\nraise RuntimeError("no such luck")\n')
    yield installed
    module.write_text(sound)


def test_the_wheel_is_what_runs(installed: Installed) -> None:
    code = "import nerfloom, dense_grid as d; print(*(m.__file__ for m in (nerfloom, d)))"
    files = checked([installed.python, "-c", code], installed.folder).split()
    assert [Path(file).is_relative_to(installed.modules) for file in files] == [True, True]


def test_the_wheel_holds_all_that_the_sources_hold(installed: Installed) -> None:
    """Templates, the report's page, the kernels' sources and the marks of types too."""
    sources = installed.folder.parent / "sources"
    files = [file for package in PACKAGES for file in (sources / package).rglob("*") if file.is_file()]
    assert {file.suffix for file in files} >= {".py", ".typed", ".jinja", ".template", ".cpp", ".h"}
    places = {file: file.relative_to(sources).as_posix().removeprefix("framework/") for file in files}
    assert [file for file, place in places.items() if not (installed.modules / "nerfloom" / place).is_file()] == []


def test_the_wheel_installs_one_name(installed: Installed) -> None:
    code = "from importlib.metadata import files; print(*{path.parts[0] for path in files('nerfloom')})"
    names = checked([installed.python, "-c", code], installed.folder).split()
    assert {name for name in names if name != ".." and not name.endswith(".dist-info")} == {"nerfloom"}


def test_it_trains_and_is_evaluated(installed: Installed) -> None:
    listed = installed.run("ns-train", "--help").stdout
    assert re.search("dense-grid +DenseGrid: features on dense grids", listed)
    assert "--features-per-level" in installed.run("ns-train", "dense-grid", "--help-all").stdout
    done, folder = installed.train("dense-grid", SMALL, "t")
    assert done.returncode == 0, done.stderr
    before = json.loads((folder / "eval.json").read_text())["results"]
    done = installed.run("ns-eval", "--load-config", folder / "config.yml", "--max-images", 2)
    assert done.returncode == 0, done.stderr
    after = json.loads((folder / "eval.json").read_text())["results"]
    assert after["psnr"] == before["psnr"] > 5


def test_it_is_compared_beside_another(installed: Installed) -> None:
    output = installed.folder / "compared"
    flags = ["--max-num-iterations", 20, "--max-eval-images", 2, "--curve-images", 1, "--output-dir", output]
    methods = [f"dense-grid {SMALL}", f"instant-ngp {TINY_NGP}"]
    done = installed.run("ns-compare", "--methods", *methods, f"--data-flags={SCENE}", *flags)
    assert done.returncode == 0, done.stderr
    content = json.loads((output / "results.json").read_text())
    assert [measured["method"] for measured in content["runs"]] == ["dense-grid", "instant-ngp"]


def test_its_own_tests_pass(installed: Installed) -> None:
    said = checked([installed.python, "-m", "pytest", "-q", installed.folder.parent / "example"], installed.folder)
    assert "2 passed" in said


def test_ns_new_method_knows_its_templates(installed: Installed) -> None:
    done = installed.run("ns-new-method", "another-grid", "--dir", installed.folder / "another")
    assert done.returncode == 0, done.stderr
    assert (installed.folder / "another" / "src" / "another_grid.py").is_file()
    assert "there is a method 'dense-grid' already" in installed.run("ns-new-method", "dense-grid").stderr


def test_broken_it_stops_nobody_else(broken: Installed) -> None:
    done = broken.run("ns-train", "--help")
    assert done.returncode == 0, done.stderr
    assert re.search(r"dense-grid +Never loads\.", done.stdout)
    done, folder = broken.train("instant-ngp", TINY_NGP, "beside")
    assert done.returncode == 0, done.stderr
    assert (folder / "eval.json").is_file()
    done, folder = broken.train("dense-grid", "", "broken")
    assert done.returncode == 1
    assert "'dense-grid'" in done.stderr
    assert "nerfloom-dense-grid cannot be loaded: RuntimeError: no such luck" in done.stderr
    assert "Traceback" not in done.stderr
    assert not folder.exists()

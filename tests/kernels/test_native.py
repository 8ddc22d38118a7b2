"""Finding the compiled library, and the checks before an address leaves Python."""

import platform
import shutil
from pathlib import Path

import pytest
import torch

from nerfloom.base.device import cpu_features
from nerfloom.kernels import native
from nerfloom.kernels.sources import fingerprint
from tests.forked import Forks
from tests.kernels.compiled import needs_kernels
from tests.sanitize.build import extensions

GOOD = torch.zeros(4, 3)


@pytest.mark.parametrize(
    ("tensor", "message"),
    [
        (GOOD.double(), "the table has type torch.float64, not torch.float32"),
        (GOOD[:3], r"the table has shape \(3, 3\), not \(4, 3\)"),
        (torch.zeros(3, 4).t(), "the table is not contiguous"),
        (torch.zeros(4, 3, device="meta"), "the table is on meta, not on the CPU"),
    ],
)
def test_pointer_names_what_is_wrong(tensor: torch.Tensor, message: str) -> None:
    assert native.pointer(GOOD, "the table", (4, 3)) == GOOD.data_ptr()
    with pytest.raises(ValueError, match=message):
        native.pointer(tensor, "the table", (4, 3))


def test_the_reference_can_be_asked_for(forks: Forks) -> None:
    code = "from nerfloom.kernels import native; print(native.variant(), native.available())"
    assert forks.run(code, NERFLOOM_KERNELS="reference").stdout.split() == ["reference", "False"]


def test_an_unknown_variant_is_an_error_that_lists_the_known(forks: Forks) -> None:
    done = forks.run("from nerfloom.kernels import native; native.variant()", NERFLOOM_KERNELS="sse9")
    assert done.returncode == 1
    assert "NERFLOOM_KERNELS is 'sse9'; it must be one of auto, reference, amx_bf16, avx512_bf16" in done.stderr


def test_a_missing_library_is_said_once_and_torch_goes_on(tmp_path: Path, forks: Forks) -> None:
    code = (
        "from pathlib import Path\n"
        "from nerfloom.kernels import native\n"
        f"native.FOLDER = Path({str(tmp_path)!r})\n"
        "from nerfloom.kernels.networks.mlp import mlp\n"
        "import torch\n"
        "for _ in range(3): out = mlp([torch.ones(2, 3)], [torch.ones(1, 3)])\n"
        "print(out.tolist())"
    )
    done = forks.run(code, NERFLOOM_KERNELS="auto")
    assert done.returncode == 0
    said = done.stdout + done.stderr
    assert said.count("without its compiled kernels (they were not built)") == 1
    assert "[[3.0], [3.0]]" in said
    (tmp_path / f"avx2{native.SUFFIX}").touch()
    (tmp_path / f"amx_bf16{native.SUFFIX}").touch()
    done = forks.run(code.replace("native.FOLDER", "native.cpu_features = set\nnative.FOLDER"), NERFLOOM_KERNELS="auto")
    said = done.stdout + done.stderr
    assert "(they were built for another processor: amx_bf16, avx2)" in said
    assert "[[3.0], [3.0]]" in said
    broken = forks.run(code, NERFLOOM_KERNELS="avx2")
    assert broken.returncode == 1
    assert "NERFLOOM_KERNELS asks for 'avx2'" in broken.stderr


@needs_kernels
def test_a_function_that_is_not_there() -> None:
    assert not native.has("no_such_kernel")
    with pytest.raises(AttributeError):
        native.Function("no_such_kernel", "")()


@needs_kernels
@pytest.mark.parametrize("variant", [name for name, needs in native.NEEDS.items()])
def test_every_variant_that_fits_this_processor_gives_the_same_answer(variant: str, forks: Forks) -> None:
    if not native.cpu_features().issuperset(native.NEEDS[variant]):
        pytest.skip(f"this processor has no {variant}")
    if not (native.FOLDER / f"{variant}{native.SUFFIX}").is_file():
        pytest.skip(f"{variant} was not built; NERFLOOM_VARIANTS=all builds every one")
    code = (
        "import torch\n"
        "from nerfloom.kernels import native\n"
        "from nerfloom.kernels.grids.hash_grid import HashGridLayout, hash_grid, hash_grid_reference\n"
        "from nerfloom.kernels.networks.mlp import mlp, mlp_reference\n"
        "torch.manual_seed(0)\n"
        "layout = HashGridLayout.build(4, 4, 64, 10)\n"
        "x, table = torch.rand(99, 3), torch.randn(layout.num_entries, 2)\n"
        "encoded = hash_grid(x, table, layout)\n"
        "error = (encoded - hash_grid_reference(x, table, layout)).abs().max()\n"
        "weights = [torch.randn(20, 8), torch.randn(3, 20)]\n"
        "other = (mlp([encoded], weights) - mlp_reference([encoded], weights)).abs().max()\n"
        "with torch.autocast('cpu', torch.bfloat16): rounded = mlp([encoded], weights)\n"
        "apart = (rounded - mlp_reference([encoded], weights)).norm() / rounded.norm()\n"
        "print(native.variant(), bool(error < 1e-5), bool(other < 1e-4), bool(apart < 1e-2))"
    )
    done = forks.run(code, NERFLOOM_KERNELS=variant)
    assert done.stdout.split() == [variant, "True", "True", "True"], done.stderr


@needs_kernels
def test_libraries_of_other_sources_are_not_called(tmp_path: Path, forks: Forks) -> None:
    """After an update of a checkout, a function's arguments may have changed, and it would read foreign memory."""
    code = (
        "from pathlib import Path\n"
        "from nerfloom.kernels import native\n"
        f"native.SOURCES = Path({str(tmp_path)!r})\n"
        "print(native.variant())"
    )
    shutil.copytree(native.SOURCES, tmp_path, dirs_exist_ok=True)
    variant = native.variant()
    assert forks.run(code, NERFLOOM_KERNELS=variant).stdout.split() == [variant]
    header = tmp_path / "march" / "waves.h"
    header.write_bytes(header.read_bytes() + b"\n")
    chosen = forks.run(code, NERFLOOM_KERNELS="auto")
    assert chosen.stdout.split()[-1] == "reference"
    assert "without its compiled kernels (they were built from other sources)" in chosen.stdout + chosen.stderr
    asked = forks.run(code, NERFLOOM_KERNELS=variant)
    assert asked.returncode == 1
    assert "does not load: they were built from other sources" in asked.stderr


def test_every_file_counts_by_name_and_content(tmp_path: Path) -> None:
    def number(**files: str) -> int:
        folder = tmp_path / "-".join([*files, *files.values()])
        (folder / "family").mkdir(parents=True)
        for name, text in files.items():
            (folder / "family" / name.replace("_", ".")).write_text(text)
        return fingerprint(folder)

    numbers = [number(a_cpp="x", b_h="y"), number(a_cpp="xy", b_h=""), number(c_cpp="x", b_h="y"), number(b_h="y")]
    assert len(set(numbers)) == 4
    assert all(0 <= each < 2**63 for each in numbers)
    assert numbers[0] == number(b_h="y", a_cpp="x", notes_txt="z")


@needs_kernels
def test_where_the_system_gives_no_tiles_the_next_variant_is_taken(forks: Forks) -> None:
    if not native.cpu_features().issuperset(native.NEEDS["amx_bf16"]):
        pytest.skip("this processor has no tiles")
    code = (
        "import ctypes\n"
        "from nerfloom.kernels import native\n"
        "opened = ctypes.CDLL\n"
        "class Refused:\n"
        "    def __init__(self, path):\n"
        "        self.ask_for_tiles, self.built_from = lambda: b'no tiles today', opened(path).built_from\n"
        "native.ctypes.CDLL = lambda path: Refused(path) if 'amx' in path else opened(path)\n"
        "print(native.variant())"
    )
    done = forks.run(code, NERFLOOM_KERNELS="auto")
    assert done.stdout.split()[-1] in ("avx512_bf16", "reference"), done.stderr  # the latter where that was not built
    asked = forks.run(code, NERFLOOM_KERNELS="amx_bf16")
    assert asked.returncode == 1
    assert "no tiles today" in asked.stderr


def test_setup_builds_every_variant_or_the_one_that_this_processor_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    def built() -> list[str]:
        return [extension.name.rsplit(".", 1)[-1] for extension in extensions()]

    monkeypatch.setenv("NERFLOOM_VARIANTS", "all")
    there = set(native.NEEDS) if platform.system() == "Linux" else set(native.NEEDS) - {"amx_bf16"}
    assert set(built()) == (there if platform.machine() in ("x86_64", "AMD64") else {"baseline"})
    monkeypatch.delenv("NERFLOOM_VARIANTS")
    here = [name for name, needs in native.NEEDS.items() if cpu_features().issuperset(needs)]
    assert built() == here[::-1] or platform.system() != "Linux"  # the last that compiles is built

"""What `--version --environment` prints, and that it prints on a broken installation too."""

import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

import nerfloom
from nerfloom.base import device
from nerfloom.cli import environment as described
from nerfloom.cli import train
from nerfloom.kernels import native


def table(text: str) -> dict[str, str]:
    return {line[:10].strip(): line[10:] for line in text.splitlines()}


def test_it_says_what_a_report_needs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["ns-train", "--version", "--environment"])
    monkeypatch.setenv("NERFLOOM_SOMETHING", "on")
    train.main()
    rows = table(capsys.readouterr().out)
    assert {"nerfloom", "Python", "torch", "kernels", "CPU", "GPU", "memory", "system", "packages"} < set(rows)
    assert rows["nerfloom"].startswith(f"{nerfloom.__version__} from ")
    assert rows["Python"].startswith(".".join(map(str, sys.version_info[:3])))
    assert rows["torch"].startswith(f"{torch.__version__}, ")
    assert rows["kernels"].startswith(f"{native.variant()} on the CPU")
    assert rows["memory"] == f"{device.machine_memory() / 1e9:.1f} GB"
    assert "NERFLOOM_SOMETHING=on" in rows["variables"]
    assert all(f"{extra}: " in rows["extras"] for extra in ("video", "plots", "viewer", "export", "lpips"))
    assert not [row for row in rows.values() if "cannot be found out" in row]


def test_a_broken_installation_is_what_it_is_for(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> str:
        raise OSError("libtorch.so: cannot open\nshared object file")

    monkeypatch.setattr(described, "_torch", broken)
    rows = table(described.environment())
    assert rows["torch"] == "cannot be found out: OSError: libtorch.so: cannot open shared object file"
    assert rows["kernels"]


@pytest.mark.medium
def test_the_version_alone_does_not_load_torch() -> None:
    code = (
        "import sys; sys.argv = ['ns-train', '--version']; from nerfloom.cli.train import main; main();"
        "sys.exit('torch' in sys.modules)"
    )
    root = Path(__file__).parents[2]
    seconds = []
    for _ in range(3):
        start = time.perf_counter()
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=root)
        seconds.append(time.perf_counter() - start)
        assert done.returncode == 0, done.stderr
    print(f"ns-train --version: {min(seconds):.2f} s at best of 3")
    assert min(seconds) < 0.5

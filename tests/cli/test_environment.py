"""The output of `--version --environment`, also on a broken installation."""

import sys

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
    assert not [row for row in rows.values() if "unknown" in row]


def test_a_broken_installation_is_what_it_is_for(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> str:
        raise OSError("libtorch.so: cannot open\nshared object file")

    monkeypatch.setattr(described, "_torch", broken)
    rows = table(described.environment())
    assert rows["torch"] == "unknown: OSError: libtorch.so: cannot open shared object file"
    assert rows["kernels"]

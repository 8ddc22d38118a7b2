"""The program of the guide, on a floor that a capture sees."""

from pathlib import Path

import pytest
import torch

import nerfloom
from nerfloom.splats.files import read_gaussians, write_gaussians
from nerfloom.training.load import load
from tests.dataparsers.captures import write_capture
from tests.edit.clouds import at
from tests.site.test_snippets import python, run_block


def test_the_guides_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    side = torch.linspace(-1.2, 1.2, 40, dtype=torch.float64)
    floor = torch.cartesian_prod(side, side, torch.zeros(1, dtype=torch.float64))
    given = at(torch.cat([floor, torch.tensor([[0.0, 0.0, 9.0]]).double()]), 0.05)
    write_gaussians(tmp_path / "floor.ply", given.map(torch.Tensor.float))
    opened = load(tmp_path / "floor.ply", data=write_capture(tmp_path / "capture"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(nerfloom, "load", lambda path: opened)
    for block in python("guides/edit"):
        run_block(block, {})
    found = read_gaussians(tmp_path / "clean.spz").gaussians
    assert len(found) == len(floor)
    assert float(found.means[:, 2].abs().max()) < 1e-3

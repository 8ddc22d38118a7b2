"""ns-blocks with Gaussians: all blocks' file has what the blocks' own files have, each place once."""

import json
import math
from pathlib import Path

import pytest
import torch

from nerfloom.blocks.files import read_blocks
from nerfloom.kernels.splats.project import DC
from nerfloom.splats.files import read_gaussians
from nerfloom.splats.gaussians import Gaussians
from tests.cli.helpers import called

METHOD = "gaussian-splatting --start random --start-gaussians 300 --num-gaussians 400 --degree 1"
STREET = "--data-flags=--street 2 --size 24 --num-train 18 --changing-exposure True"
SPLIT = ("--max-cameras", 12, "--min-cameras", 3, "--overlap", 0.2)


def exported(path: Path, folder: Path) -> Gaussians:
    done = called("ns-export", "gaussian-splat", path, "--output-dir", folder)
    assert done.returncode == 0, done.stderr
    return read_gaussians(folder / "splat.ply").gaussians


@pytest.mark.slow
def test_a_street_of_gaussians(tmp_path: Path) -> None:
    town = tmp_path / "town"
    flags = ("--max-num-iterations", 20, "--num-threads", 1, "--device-type", "cpu", "--output-dir", town)
    done = called("ns-blocks", "--method", METHOD, STREET, *SPLIT, *flags)
    assert done.returncode == 0, done.stderr
    blocks = read_blocks(town / "blocks.yml").blocks
    assert len(blocks) == 2
    centers, found = torch.tensor([block.center for block in blocks], dtype=torch.float64), []
    for number, block in enumerate(blocks):
        own = exported(block.run, tmp_path / f"{number}")
        own = own[torch.cdist(own.means.double(), centers).argmin(-1) == number]
        matrix = torch.tensor(block.color)
        shown = (0.5 + DC * own.colors) @ matrix[:, :3].T + matrix[:, 3]
        found.append((own.means, own.log_scales, (shown - 0.5) / DC))
        assert len(own) > 20
    assert any(block.color != blocks[0].color for block in blocks)
    both = exported(town, tmp_path / "both")
    for value, expected in zip((both.means, both.log_scales, both.colors), zip(*found, strict=True), strict=True):
        torch.testing.assert_close(value, torch.cat(expected), atol=2e-4, rtol=1e-4)
    done = called("ns-eval", town, "--max-images", 2, "--device-type", "cpu")
    assert done.returncode == 0, done.stderr
    assert math.isfinite(json.loads((town / "blocks.eval.json").read_text())["results"]["psnr"])

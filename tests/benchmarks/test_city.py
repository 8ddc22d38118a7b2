"""A city on paper: the page equals the command's output, and formulas agree with the package."""

import json
import math
from pathlib import Path

import pytest
import torch
import yaml

from benchmarks.city import City, Constants, Measured, constants, markdown, measured, rows
from nerfloom.base.errors import FlagError
from nerfloom.blocks.block import TrainedBlock
from nerfloom.blocks.files import BlockList, write_blocks
from nerfloom.blocks.split import grid_blocks
from nerfloom.blocks.visibility import Visibility
from nerfloom.cameras.poses import Placement
from nerfloom.training.block_plan import BlockPlan
from tests.training.helpers import tiny_trainer

ROOT = Path(__file__).parents[2]


def value(what: str, city: City, found: Measured) -> str:
    (row,) = [row for row in rows(city, constants(), found) if row.what == what]
    return row.value


def test_the_page_shows_what_the_command_prints() -> None:
    page = (ROOT / "docs" / "notes" / "city.md").read_text(encoding="utf-8")
    assert markdown(City(), constants(), measured(ROOT / "docs" / "results")) in page


def test_images_of_a_block_are_those_of_a_grid() -> None:
    """A lattice of cameras in a plane, in blocks of a grid: inner blocks have about the formula's number."""
    side, blocks = 60, 6
    x, y = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    positions = torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3).double()
    for overlap in (0.2, 0.5):
        found = grid_blocks(positions, side / blocks, overlap, 1)
        assert len(found) == blocks**2
        within = sorted(len(block.cameras) for block in found)[-((blocks - 2) ** 2) :]
        expected = side**2 / blocks**2 / (1 - overlap) ** 2
        assert sum(within) / len(within) == pytest.approx(expected, rel=0.15)
        city = City(images=side**2, blocks=blocks**2, overlap=overlap)
        assert float(value("images of a block", city, Measured()).replace(",", "")) == pytest.approx(expected, rel=0.01)


def test_lists_of_images_take_as_many_bytes_as_the_formulas_say(tmp_path: Path) -> None:
    """Indices of seven digits: 15 bytes of plan.json, 13 of recipe.json, and 9 of blocks.yml."""
    count, few = 20_000, 100
    sizes: dict[str, list[int]] = {"plan.json": [], "runs/000/recipe.json": [], "blocks.yml": []}
    for number in (few, count):
        cameras = tuple(range(1_000_000, 1_000_000 + number))
        block = TrainedBlock((0.0, 0.0, 0.0), 1.0, cameras, tmp_path)
        (tmp_path / "plan.json").unlink(missing_ok=True)
        BlockPlan("nerfacto", (), (block,), (None,), tmp_path, "").claim_folder(Placement.of(None, 1.0))
        write_blocks(tmp_path / "blocks.yml", BlockList(((-1.0,) * 3, (1.0,) * 3), 0.05, 1e3, (block,)))
        for name, found in sizes.items():
            found.append((tmp_path / name).stat().st_size)
    each = {name: (after - before) / (count - few) for name, (before, after) in sizes.items()}
    assert each["plan.json"] == pytest.approx(15, abs=0.01)
    assert each["runs/000/recipe.json"] == pytest.approx(13, abs=0.01)
    assert each["blocks.yml"] == pytest.approx(9, rel=0.1)
    assert yaml.safe_load((tmp_path / "blocks.yml").read_text())["blocks"][0]["cameras"][-1] == 1_000_000 + count - 1
    city = City(images=2_000_000, blocks=1, overlap=0.0)
    assert value("`plan.json`", city, Measured()) == "30 MB"
    assert value("`blocks.yml`", city, Measured()) == "18 MB"
    assert value("`recipe.json` of a block", city, Measured()) == "26 MB"


def test_constants_are_those_of_the_package() -> None:
    found: Constants = constants()
    assert found.network == sum(values.numel() for values in Visibility((0.0, 0.0, 0.0), 1.0).parameters())
    assert (found.row, found.short_row, found.stored) == (236, 124, 732)


def test_what_was_not_measured_is_said(tmp_path: Path) -> None:
    nothing = measured(tmp_path)
    assert all(math.isnan(value) for value in vars(nothing).values())
    assert markdown(City(), constants(), nothing).count("not measured") == 17
    (tmp_path / "city.json").write_text(json.dumps({"levels_seconds": 9.0, "rays": 1000, "levels_frames": 2.5}))
    some = measured(tmp_path)
    assert value("time of building levels", City(), some) == "75 min"
    assert value("rays of a block's training", City(), some) == "600,000"
    assert value("pictures of levels per second", City(), some) == "2.5"


@pytest.mark.parametrize(("name", "wrong"), [("overlap", 1.0), ("blocks", 0), ("seconds", math.inf)])
def test_inputs_out_of_range_are_refused(name: str, wrong: float) -> None:
    with pytest.raises(FlagError, match=f"--{name} is"):
        City(**{name: wrong})  # type: ignore[arg-type]


@pytest.mark.medium
def test_a_checkpoint_has_three_numbers_of_a_parameter(shared_tiny: Path, tmp_path: Path) -> None:
    """The page counts 12 bytes: the parameter, and Adam's two moments. Cells of empty space and the like add little."""
    trainer = tiny_trainer("nerfacto", shared_tiny, tmp_path / "run", log2_table_size=16)
    trainer.train_step()
    parameters = sum(values.numel() for values in trainer.model.parameters())
    path = trainer.save()
    assert path is not None
    assert path.stat().st_size == pytest.approx(12 * parameters, rel=0.06)
    assert value("two checkpoints of a block", City(), Measured(parameters=float(10**6))) == "24 MB"

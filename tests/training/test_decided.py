"""Decisions for a run are kept with it: in its config.yml, its checkpoints, and when it goes on."""

from pathlib import Path

import pytest
import yaml

from nerfloom.training.checkpoint import FOLDER, load_newest
from nerfloom.training.run import read_run
from nerfloom.training.trained import load_trained
from tests.cli.helpers import called
from tests.training.helpers import tiny_run, tiny_trainer

SMALL = ("--num-levels", 2, "--samples-per-batch", 1024, "--grid-resolution", 16, "--vis", "none")


def trained(*arguments: object) -> str:
    done = called("ns-train", *arguments, "--max-eval-images", 0)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


@pytest.mark.medium
def test_a_run_goes_on_with_what_was_decided_however_long_it_then_takes(shared_tiny: Path, tmp_path: Path) -> None:
    """5 seconds get tables of 2^16 entries and dense updates, 300 would get 2^18 and sparse ones."""
    start = ("--data", shared_tiny, "--output-dir", tmp_path, "--timestamp", "t", "--max-seconds", 5)
    said = trained("instant-ngp", *start, *SMALL, "--max-num-iterations", 3, "--machine.device-type", "cpu")
    assert "log2 table size: 16, as that suits the time" in said
    folder = tmp_path / shared_tiny.name / "instant-ngp" / "t"
    written = yaml.safe_load((folder / "config.yml").read_text())
    decided = {"sampler": "occupancy", "log2_table_size": 16, "num_steps": 384, "sparse_updates": False}
    decided["learning_rate"] = 0.02
    assert {name: written[name] for name in decided} == decided
    assert written["max_resolution"] == 32  # a finest cell or more for each of 20 pixels
    assert written["samples_per_batch"] == 1024  # as was asked for
    said = trained("--resume", folder, "--max-seconds", 300, "--max-num-iterations", 6)
    assert "step 3" in said
    assert "table size" not in said  # nothing is left to decide
    checkpoint = load_newest(folder / FOLDER)
    assert checkpoint is not None
    assert checkpoint["state"]["step"] == 6
    assert {name: checkpoint["config"][name] for name in decided} == decided
    model = load_trained(folder / "config.yml").model
    assert model.field.encoding.layout.resolutions[-1] == 32
    assert {name: getattr(model.config, name) for name in decided} == decided


def test_a_recipe_leaves_open_what_it_does_not_say(shared_tiny: Path, tmp_path: Path) -> None:
    recipe = tmp_path / "recipe.yml"
    recipe.write_text(yaml.safe_dump({"method": "instant-ngp", "data": str(shared_tiny), "detail": 2}))
    config = read_run(recipe).config
    assert (config.sampler, config.log2_table_size, config.detail) == ("auto", "auto", 2)


def test_the_trainers_run_is_of_what_was_decided(shared_tiny: Path, tmp_path: Path) -> None:
    asked = tiny_run("nerfacto", shared_tiny, tmp_path / "run")
    assert asked.config.contraction == "auto"
    trainer = tiny_trainer("nerfacto", shared_tiny, tmp_path / "run")
    assert trainer.config == trainer.model.config
    assert trainer.config.contraction is False
    assert trainer.config.camera_optimizer == "off"
    assert {decision.option: decision.choice for decision in trainer.decisions}["contraction"] == "off"

"""--max-error: the bound is parsed, kept, and refused where nothing can keep it."""

from pathlib import Path

import pytest

from nerfloom.base.errors import ConfigError
from nerfloom.evaluation.error_bound import limited_error, measured_error, parse_error
from tests.training.helpers import tiny_trainer


@pytest.mark.parametrize(("text", "value"), [("0.004", 0.004), ("1/255", 1 / 255), ("0", 0.0), (" 1 / 4 ", 0.25)])
def test_numbers_and_fractions(text: str, value: float) -> None:
    assert parse_error(text) == value


@pytest.mark.parametrize("text", ["", "x", "1/0", "1", "-0.1", "nan", "1/2/3", "2/1"])
def test_what_is_no_bound(text: str) -> None:
    with pytest.raises(ConfigError, match="--max-error is"):
        parse_error(text)


@pytest.mark.medium
def test_the_bound_is_kept_and_the_setting_restored(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", evaluated=True, max_num_iterations=150)
    trainer.train()
    sampler = trainer.model.sampler
    before = sampler.early_stop
    assert trainer.eval_set is not None
    worst, _ = measured_error(trainer.model, trainer.eval_set, 0.2)
    assert 0 < worst <= 0.2
    assert sampler.early_stop == before


def test_methods_without_a_grid_refuse(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("vanilla-nerf", shared_tiny, tmp_path / "run")
    with pytest.raises(ConfigError, match="no occupancy grid"), limited_error(trainer.model, 0.1):
        pass

"""Settings that are left to the data: filled in where they are open, and reported then alone."""

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

import pytest

from nerfloom.base.config import AUTO, Auto, TrainConfig
from nerfloom.base.decisions import Choice, Decision, fill, is_open, left_open
from nerfloom.base.errors import ConfigError
from nerfloom.method import nothing_to_decide
from nerfloom.registry import load_method, registered
from nerfloom.samplers.choice import SamplingConfig
from tests.truth.test_training import SCENE


@dataclass(frozen=True)
class OpenConfig(TrainConfig):
    """Three settings that the data may decide."""

    num_cells: Auto[int] = AUTO
    """Cells."""
    fancy: Auto[bool] = AUTO
    """Whether fancy."""
    shape: Auto[Literal["ball", "box"]] = AUTO
    """Its kind."""


CHOICES = (
    Choice("num_cells", 7, "there are seven"),
    Choice("fancy", False, "nobody asked", "fanciness"),
    Choice("shape", "ball", "it is round", shown="a ball"),
)


def test_what_is_open_is_filled_in_and_reported() -> None:
    config, made = fill(OpenConfig(), *CHOICES)
    assert (config.num_cells, config.fancy, config.shape) == (7, False, "ball")
    assert made == [
        Decision("num cells", "7", "there are seven"),
        Decision("fanciness", "off", "nobody asked"),
        Decision("shape", "a ball", "it is round"),
    ]
    assert made[0].line() == "  num cells: 7, as there are seven"


def test_what_is_given_stays_and_is_not_reported() -> None:
    """This holds for values that Python takes for false, too."""
    given = OpenConfig(num_cells=0, shape="box", learning_rate=0.3)
    config, made = fill(given, *CHOICES)
    assert config == dataclasses.replace(given, fancy=False)
    assert [decision.option for decision in made] == ["fanciness"]


@pytest.mark.parametrize(
    ("value", "text"), [(0.0, "0"), (2e-3, "0.002"), (True, "on"), (2**15, "32768"), ("SO3xR3", "SO3xR3")]
)
def test_values_are_shown_as_people_write_them(value: Any, text: str) -> None:
    assert Choice("some_setting", value, "it is so").decision().choice == text


def test_filling_in_twice_changes_nothing() -> None:
    once, _ = fill(OpenConfig(), *CHOICES)
    assert fill(once, *CHOICES) == (once, [])


@pytest.mark.parametrize("method", registered("methods"))
@pytest.mark.parametrize("facts", [{}, {"unbounded": True, "appearance_varies": True, "poses": "device"}])
def test_every_method_decides_once(method: str, facts: dict) -> None:
    """Decisions are complete and stay: read from a run's config.yml, they are not made anew."""
    loaded, scene = load_method(method), dataclasses.replace(SCENE, **facts)
    config, _ = loaded.decided(loaded.config, scene)
    assert not [name for name in ("sampler", "camera_optimizer", "few_images") if is_open(getattr(config, name, 0))]
    assert left_open(config) == []
    changed = dataclasses.replace(config, max_seconds=7.0)
    again, made = loaded.decided(changed, dataclasses.replace(SCENE, unbounded=not scene.unbounded))
    assert again == changed
    assert [decision for decision in made if decision.choice != "left out"] == []


def test_what_nobody_decides_is_refused_by_name() -> None:
    """A setting that one method leaves to the data may be auto on the command line of all."""
    assert left_open(OpenConfig(fancy=True)) == ["num_cells", "shape"]
    assert left_open(OpenConfig(fancy=True, num_cells=3, shape="ball", experiment_name="auto")) == []
    for name, setting in {
        "nerfacto": "num_steps",
        "vanilla-nerf": "lr_schedule",
        "gaussian-splatting": "lr_final",
    }.items():
        method = load_method(name)
        config = dataclasses.replace(method.config, **{setting: AUTO})
        with pytest.raises(ConfigError, match=f"^--{setting.replace('_', '-')} is auto, .* give a value$"):
            method.decided(config, SCENE)


@pytest.mark.parametrize("unbounded", [False, True])
def test_a_plugin_without_decisions_gets_the_common_ones(unbounded: bool) -> None:
    """An "auto" that stays would be an occupancy grid, in a scene that goes on beyond its box too."""
    method, scene = load_method("instant-ngp"), dataclasses.replace(SCENE, unbounded=unbounded)
    plugin = dataclasses.replace(method, config=SamplingConfig(), decide=nothing_to_decide)
    config, made = plugin.decided(plugin.config, scene)
    assert config.sampler == ("proposal" if unbounded else "occupancy")
    assert [decision.option for decision in made] == ["sampler"]
    assert left_open(config) == []
    given, made = plugin.decided(SamplingConfig(sampler="occupancy"), scene)
    assert (given.sampler, made) == ("occupancy", [])


def test_a_choice_that_a_plugin_does_not_make_is_refused_by_name() -> None:
    """Poses that are asked to be refined if that helps would not be."""
    method = load_method("gaussian-splatting")
    decided, _ = method.decided(method.config, SCENE)
    plugin = dataclasses.replace(method, decide=nothing_to_decide)
    with pytest.raises(ConfigError, match=r"^--camera-optimizer is auto, .* does not decide it; give a value$"):
        plugin.decided(dataclasses.replace(decided, camera_optimizer="auto"), SCENE)
    assert plugin.decided(decided, SCENE) == (decided, [])


def test_rates_and_steps_of_dnerf_follow_its_canonical_field() -> None:
    method, moving = load_method("dnerf"), dataclasses.replace(SCENE, moving=True, num_times=150)
    names = ("lr_schedule", "lr_final", "num_steps", "eval_step_scale", "thin_gradients", "ambient_dims")
    found = {}
    for canonical, variant in (("network", "d-nerf"), ("hash-grid", "d-nerf"), ("hash-grid", "t-nerf")):
        config = dataclasses.replace(method.config, canonical=canonical, variant=variant)
        decided, _ = method.decided(config, moving)
        found[canonical, variant] = tuple(getattr(decided, name) for name in names)
    assert found["network", "d-nerf"] == ("exponential", 0.1, 192, 1.0, 0.0, 0)  # the paper's
    assert found["hash-grid", "d-nerf"] == ("hold-exponential", 0.02, 384, 0.5, 0.5, 4)
    assert found["hash-grid", "t-nerf"] == found["network", "d-nerf"]  # one network, for any grid

"""The help of `ns-train METHOD` shows flags in groups, which change neither flags nor values nor errors."""

import dataclasses
import functools
import re
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, get_type_hints

import pytest
import tyro

from nerfloom import registry
from nerfloom.base.config import AUTO, LEFT_TO_DATA, Auto, RayConfig, TrainConfig
from nerfloom.cli.evaluate import EvalFlags
from nerfloom.cli.flag_groups import EVERYDAY, GROUPS, grouped_flags
from nerfloom.cli.flag_help import DECIDED, plain_flags
from nerfloom.cli.train import run_of
from nerfloom.registry import load_dataparser, load_method
from nerfloom.samplers.choice import SamplingConfig
from tests.cli.helpers import called

METHODS = (
    "dnerf", "instant-ngp", "kilo-nerf", "kplanes", "mip-nerf", "mip-nerf-360", "nerf-plus-plus", "nerf-w", "nerfacto",
    "neus", "pixel-nerf", "ref-nerf", "tensorf", "vanilla-nerf", "volsdf", "zip-nerf",
)  # fmt: skip
FOR_FEW_IMAGES = ("instant-ngp", "kplanes", "nerf-plus-plus", "nerfacto", "tensorf", "vanilla-nerf")
"""Methods with settings for few images."""
WITH_BACKGROUND = ("instant-ngp", "nerf-plus-plus", "neus", "vanilla-nerf", "volsdf")
"""Methods with settings of a background."""
FORMATS = (
    "blender", "colmap", "dnerf", "dtu", "llff", "nerfstudio", "phototourism", "polycam", "record3d", "sdfstudio",
)  # fmt: skip
QUICK = ("instant-ngp", "nerfacto", "vanilla-nerf", "blender", "nerfstudio")
"""Methods and formats with help read in the fast set: they have every box, and a format few flags or many."""
Capture = pytest.CaptureFixture[str]


@pytest.fixture(autouse=True)
def one_column(monkeypatch: pytest.MonkeyPatch) -> None:
    """Boxes of help stand side by side where the terminal is wide enough."""
    monkeypatch.setenv("COLUMNS", "110")


def boxes(said: str) -> dict[str, list[str]]:
    """The flags of a help text, by the titles of their boxes; not every terminal shows the edges."""
    found: dict[str, list[str]] = {}
    flags: list[str] = []
    for line in said.splitlines():
        if title := re.match(r"(?:╭─)? (\w[\w. -]*? options|options) ", line):
            assert title[1] not in found
            flags = found[title[1]] = []
        elif flag := re.match(r"[│ ] (--[a-z][\w.-]*)", line):
            flags.append(flag[1])
    return found


@functools.cache
def help_of(*words: str, flag: str = "--help-all") -> dict[str, list[str]]:
    """The flags that a help shows, by their boxes."""
    done = called("ns-train", *words, flag)
    assert done.returncode == 0, done.stderr
    return boxes(done.stdout)


def flags_of(settings: Any) -> list[str]:
    """Every flag of a dataclass, a nested one's behind its name: from its fields alone."""
    flags = []
    for item in fields(settings):
        value, flag = getattr(settings, item.name), "--" + item.name.replace("_", "-")
        nested = fields(value) if dataclasses.is_dataclass(value) else ()
        flags += [f"{flag}.{inner.name.replace('_', '-')}" for inner in nested] or [flag]
    return flags


@pytest.mark.parametrize("method", [pytest.param(m, marks=() if m in QUICK else pytest.mark.slow) for m in METHODS])
def test_every_flag_once_and_the_everyday_ones_first(method: str) -> None:
    found = help_of(method)
    known = flags_of(load_method(method).config) + flags_of(load_dataparser("procedural")())
    assert sorted(flag for flags in found.values() for flag in flags) == sorted(known)
    assert list(found) == [
        "options", "everyday options", f"{method} options", *["sampler options"] * (method != "pixel-nerf"),
        *["background options"] * (method in WITH_BACKGROUND), "ray options", "robust options", "appearance options",
        *["few images options"] * (method in FOR_FEW_IMAGES), *["motion options"] * (method in ("kplanes", "dnerf")),
        "teacher options", "optimisation options", "evaluation and saving options",
        "machine options", "viewer options", "procedural data options",
    ]  # fmt: skip
    first = ["--data", "--max-seconds", "--max-num-iterations", "--output-dir", "--experiment-name", "--rays-per-pixel"]
    assert found["everyday options"][:6] == first


@pytest.mark.parametrize("flag", ["-h", "--help"])
def test_the_short_help_shows_the_everyday_flags_alone(flag: str) -> None:
    """This holds for every method and data format, and beside other flags."""
    all_flags, short = help_of("nerfacto", "blender"), help_of("nerfacto", "--num-levels", "3", "blender", flag=flag)
    assert short == {"options": [], "everyday options": all_flags["everyday options"]}
    assert help_of("dnerf", flag=flag) == short
    assert len(all_flags) > len(short)


def test_the_everyday_flags_are_shown_with_their_defaults() -> None:
    said = " ".join(called("ns-train", "nerfacto", "--help").stdout.replace("│", " ").split())
    for flag in GROUPS[EVERYDAY]:
        assert f" --{str(flag).replace('_', '-')} " in said
    assert f"(default: {load_method('nerfacto').config.max_num_iterations})" in said


def test_the_help_of_a_command_with_few_flags_shows_them_all() -> None:
    short, all_flags = (called("ns-eval", flag) for flag in ("--help", "--help-all"))
    assert short.stdout == all_flags.stdout
    assert set(boxes(short.stdout)["options"]) == set(flags_of(EvalFlags(load_config=Path("run"))))


@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in FORMATS])
def test_the_data_formats_flags_stand_last(name: str) -> None:
    found = help_of("dnerf", name)
    assert list(found)[-1] == f"{name} data options"
    assert found[f"{name} data options"] == flags_of(load_dataparser(name)())


def test_flags_stand_with_what_they_belong_to() -> None:
    found, plain = help_of("nerfacto"), help_of("vanilla-nerf")
    belongs = {
        "nerfacto": ["--num-levels", "--camera-learning-rate"],
        "sampler": ["--sampler", "--early-stop", "--num-proposal-samples", "--silhouette-cells"],
        "ray": ["--num-rays-per-batch", "--train-rays-per-pixel-from"],
        "robust": ["--robust"],
        "teacher": ["--teacher", "--teacher-share", "--teacher-until"],
        "optimisation": ["--learning-rate", "--lr-schedule", "--adam-eps"],
        "evaluation and saving": ["--steps-per-save", "--max-eval-images", "--target-psnr", "--load-checkpoint"],
        "machine": ["--machine.seed", "--machine.device-type", "--mixed-precision", "--cache-limit"],
    }
    for title, flags in belongs.items():
        assert set(flags) <= set(found[f"{title} options"])
    light = ["--appearance", "--eval-appearance", "--mean-appearance-share"]
    assert plain["appearance options"] == light
    assert found["appearance options"] == [*light, "--appearance-embedding-dim"]
    assert "--num-coarse-samples" in plain["sampler options"]


def test_settings_that_are_named_exist() -> None:
    named = {member for members in GROUPS.values() for member in members if isinstance(member, str)}
    assert named <= {item.name for item in fields(RayConfig)}


def test_a_method_that_casts_no_rays_has_no_flags_of_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    plugins = ",".join(f"{name}=tests.interfaces.methods.{name}:METHOD" for name in ("discs", "cones"))
    monkeypatch.setenv("NERFLOOM_METHODS", plugins)
    registry.registered.cache_clear()
    try:
        discs, cones = help_of("discs"), help_of("cones")
    finally:
        monkeypatch.undo()
        registry.registered.cache_clear()
    assert discs["discs options"] == ["--num-discs"]
    assert not {"ray options", "robust options", "sampler options", "appearance options"} & set(discs)
    assert not [flag for flags in discs.values() for flag in flags if "ray" in flag or "sampl" in flag]
    assert cones["cones options"] == ["--num-frequencies", "--num-samples"]
    assert "--num-rays-per-batch" in cones["ray options"]
    assert "--rays-per-pixel" in cones["everyday options"]


@dataclass(frozen=True)
class Water:
    """A group of a plugin's own."""

    depth: float = 3.0
    """How deep it is."""


@dataclass(frozen=True)
class Shared(SamplingConfig):
    """Settings that several methods of a plugin share."""

    murk: float = 0.5
    """How little is seen
    through it."""


@dataclass(frozen=True)
class Plugin(Shared, learning_rate=3.0, num_steps=AUTO):
    """A method's own, and changed ones."""

    early_stop: float = 0.25
    """Another help for the same flag."""
    tint: Auto[tuple[float, float]] = AUTO
    """Of the water."""
    water: Water = field(default_factory=Water)
    """What is in the way."""


def parsed(config: TrainConfig, *flags: str, grouped: bool = True) -> Any:
    """Settings changed by flags, and, for comparison, without groups."""
    parser = load_dataparser("blender")()
    rules = grouped_flags("mine", config, "blender", parser) if grouped else plain_flags()
    options = (tyro.conf.FlagConversionOff,)
    return tyro.cli(type(config), args=flags, default=config, config=options, registry=rules)


def test_a_plugins_settings_stand_by_themselves(capsys: Capture) -> None:
    with pytest.raises(SystemExit):
        parsed(Plugin(), "--help")  # of all groups: whether the help is short is said to grouped_flags
    said = capsys.readouterr().out
    found = boxes(said)
    assert found["mine options"] == ["--murk", "--tint"]
    assert found["water options"] == ["--water.depth"]
    assert {"--early-stop", "--num-steps"} <= set(found["sampler options"])
    assert "--learning-rate" in found["optimisation options"]
    for text in (
        "Another help for the same flag. (default: 0.25)",
        "How little is seen through it. (default: 0.5)",  # on one line, unlike in the source
        f"Of the water. {DECIDED}",
    ):
        assert text in said
    flags = ("--tint", "1", "2", "--water.depth", "7", "--num-steps", "auto", "--murk", "0")
    expected = dataclasses.replace(Plugin(), tint=(1.0, 2.0), water=Water(7.0), murk=0.0)
    assert parsed(Plugin(), *flags) == parsed(Plugin(), *flags, grouped=False) == expected


def test_what_the_data_decide_is_not_called_none() -> None:
    said = " ".join(called("ns-train", "instant-ngp", "--help-all").stdout.replace("│", " ").split())
    config = load_method("instant-ngp").config
    hints = get_type_hints(type(config), include_extras=True)
    may_be = [name for name, hint in hints.items() if LEFT_TO_DATA in getattr(hint, "__metadata__", ())]
    is_open = [name for name in may_be if getattr(config, name) == AUTO]
    assert {"max_resolution", "log2_table_size", "num_steps"} <= set(is_open)
    assert said.count(DECIDED) == len(is_open)
    assert "Stop after this many seconds of training" in said
    assert "(default: None)" not in said
    assert "{None" not in said


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ("", {}),
        (
            "--num-proposal-samples 128 64 --background white",
            {"num_proposal_samples": (128, 64), "background": "white"},
        ),
        ("--num-proposal-samples 32 --rays-per-pixel 9", {"num_proposal_samples": (32,), "rays_per_pixel": 9}),
        ("--lr-schedule cosine --sampler occupancy", {"lr_schedule": "cosine", "sampler": "occupancy"}),
        ("--mixed-precision True --robust scout", {"mixed_precision": True, "robust": "scout"}),
        ("--contraction False --silhouette-cells False", {"contraction": False, "silhouette_cells": False}),
        ("--contraction auto --num-steps auto --max-seconds None", {"contraction": "auto", "num_steps": "auto"}),
        ("--output-dir a/b --max_seconds 3 --learning-rate=1e-3", {"output_dir": Path("a/b"), "max_seconds": 3.0}),
        ("--max-seconds 1 --adam-eps 1e-9 --max-seconds 2", {"max_seconds": 2.0, "adam_eps": 1e-9}),
        ("--eval-appearance half --camera-optimizer SE3", {"eval_appearance": "half", "camera_optimizer": "SE3"}),
    ],
)
def test_values_are_those_without_groups(flags: str, expected: dict[str, Any]) -> None:
    config = load_method("nerfacto").config
    run = run_of("nerfacto", flags.split())
    plain = parsed(config, *flags.split(), grouped=False)
    steps = None if plain.max_seconds is not None else plain.max_num_iterations
    assert run.config == dataclasses.replace(plain, max_num_iterations=steps)
    assert {name: getattr(run.config, name) for name in expected} == expected


def test_nested_flags_and_those_of_the_format_in_any_order() -> None:
    words = "--machine.seed 7 --size 32 --early-stop 0.1 --moving True --machine.device-type cpu --num-train 5"
    run = run_of("vanilla-nerf", words.split())
    assert (run.config.machine.seed, run.config.machine.device_type, run.config.early_stop) == (7, "cpu", 0.1)  # type: ignore[attr-defined]
    assert run.parser == load_dataparser("procedural")(size=32, num_train=5, moving=True)  # type: ignore[call-arg]


@pytest.mark.parametrize("flags", ["--max-secnds 3", "--learning-rate x", "--background blue", "--machine.seed x"])
def test_errors_are_those_without_groups(flags: str, capsys: Capture) -> None:
    said = []
    for grouped in (True, False):
        with pytest.raises(SystemExit) as end:
            parsed(load_method("nerfacto").config, *flags.split(), grouped=grouped)
        said.append((end.value.code, *capsys.readouterr()))
    assert said[0] == said[1]
    assert said[0][:2] == (2, "")
    assert flags.split()[0] in said[0][2]


def test_an_unknown_flag_is_one_message_with_the_nearest() -> None:
    done = called("ns-train", "nerfacto", "--max-secnds", 3)
    assert (done.returncode, done.stdout) == (2, "")
    words = "unknown flag --max-secnds. Did you mean '--max-seconds'? ns-train nerfacto --help shows the flags"
    assert done.stderr == f"error: {words}\n"

"""Settings: to YAML and back, and wrong ones refused by name."""

import contextlib
import dataclasses
import io
import typing
from dataclasses import dataclass
from pathlib import Path

import pytest
import tyro
import yaml

from nerfloom.base.config import RayConfig, TrainConfig
from nerfloom.base.errors import ConfigError
from nerfloom.base.plain import from_plain, to_plain
from nerfloom.registry import load_method, registered
from nerfloom.training.run import read_run


@pytest.mark.parametrize("method", ["instant-ngp", "vanilla-nerf"])
def test_every_methods_config_survives_yaml(method: str) -> None:
    config = dataclasses.replace(load_method(method).config, data=Path("a/b"), max_seconds=2.5, target_psnr=30.0)
    text = yaml.safe_dump(to_plain(config))
    assert from_plain(load_method(method).config, yaml.safe_load(text), "text") == config


@dataclass(frozen=True)
class Younger(RayConfig):
    GONE: typing.ClassVar[dict[str, object]] = {"blur_widths": (1, 2.5)}


@dataclass(frozen=True)
class Youngest(Younger):
    GONE: typing.ClassVar[dict[str, object]] = {"blocks": 3, "half_rays": lambda config: config.num_rays_per_batch // 2}


@dataclass(frozen=True)
class WithBlocks(Youngest):
    blocks: int = 5


def test_files_with_settings_that_are_gone_are_read_if_nothing_changes() -> None:
    text = yaml.safe_dump({"learning_rate": 0.5, "blur_widths": [1, 2.5], "blocks": 3})
    assert from_plain(Youngest(), yaml.safe_load(text), "text") == Youngest(learning_rate=0.5)
    with pytest.raises(ConfigError, match="text: 'blocks' is 4, but now it is 3; leave it out"):
        from_plain(Youngest(), {"blocks": 4}, "text")
    fewer = {"half_rays": 8, "num_rays_per_batch": 16}  # compared with the settings of the file, not with the defaults
    assert from_plain(Youngest(), fewer, "text") == Youngest(num_rays_per_batch=16)
    with pytest.raises(ConfigError, match="text: 'half_rays' is 8, but now it is 16; leave it out"):
        from_plain(Youngest(), {**fewer, "num_rays_per_batch": 32}, "text")
    assert from_plain(WithBlocks(), {"blocks": 4}, "text") == WithBlocks(blocks=4)
    with pytest.raises(ConfigError, match="unknown key 'blocks'"):
        from_plain(Younger(), {"blocks": 3}, "text")


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"learning_rat": 1}, "unknown key 'learning_rat'. Did you mean 'learning_rate'"),
        ({"machine": {"sed": 1}}, "unknown key 'sed'"),
        ({"max_num_iterations": "many"}, "'max_num_iterations' is 'many'; it must be int"),
        ({"max_num_iterations": 1.5}, "must be int"),
        ({"max_num_iterations": True}, "must be int"),
        ({"steps_per_save": None}, "must be int"),
        ({"save_only_latest_checkpoint": 1}, "must be bool"),
        ({"lr_schedule": "linear"}, "must be one of constant, exponential"),
        ({"data": 3}, "must be Path"),
        ({"max_num_iterations": 0}, "--max-num-iterations is 0; it must be at least 1"),
        ({"max_seconds": -1}, "--max-seconds is -1"),
        ({"learning_rate": 0}, "must be more than 0"),
        ({"rays_per_pixel": 2}, "must be one of 1, 4, 9, 16"),
        ({"train_rays_per_pixel_from": 1.5}, "--train-rays-per-pixel-from is 1.5; it must be from 0 to 1"),
        ({"learning_rate": float("nan")}, "must be more than 0"),
        ({"learning_rate": 10**400}, "'learning_rate'"),
        ({"steps_per_eval_image": 0}, "--steps-per-eval-image"),
        ({"steps_per_eval_all_images": 0}, "--steps-per-eval-all-images"),
        ({"max_eval_images": -1}, "--max-eval-images"),
        ({"adam_beta1": 1.5}, "--adam-beta1"),
        ({"adam_eps": -1.0}, "--adam-eps"),
    ],
)
def test_wrong_values_are_named(values: dict, words: str) -> None:
    with pytest.raises(ConfigError) as error:
        from_plain(RayConfig(), values, "file.yml")
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_numbers_as_yaml_writes_them() -> None:
    config = from_plain(TrainConfig(), yaml.safe_load("{learning_rate: 1e-3, max_seconds: 5}"), "text")
    assert (config.learning_rate, config.max_seconds) == (0.001, 5.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "must hold keys and values"),
        ("- a\n- b", "must hold keys and values"),
        ("a: [1", "is not plain YAML"),
        ("method: 2020-99-99", "is not plain YAML"),
        ("method: !!float ''", "is not plain YAML"),
        ("method: !!int ''", "is not plain YAML"),
        ("method: !!bool perhaps", "is not plain YAML"),
        ("method: !!timestamp now", "is not plain YAML"),
        ("method: &a instant-ngp\nexperiment_name: *a", "it has an alias (*name)"),
        ("method: instant-ngp\nmachine: {seed: 18446744073709551616}", "'seed' is 18446744073709551616; it must be"),
        ('method: instant-ngp\ndata: "a\\0b"', r"'data' is 'a\x00b'; it must be Path"),
        ('method: instant-ngp\n"a\\nb": 4', r"unknown key 'a\nb'"),
        ("method: instant-ngp\nmachine: [1]", "'machine' is [1]"),
        ("method: instant-ngp\n3: 4", "unknown key '3'"),
        ("method: instant-ngp\ndataparser: {name: 3}", "unknown data format '3'"),
        ("max_seconds: 3", "does not say which method"),
        ("method: instant-npg", "Did you mean 'instant-ngp'"),
        ("method: instant-ngp\ndataparser: blender", "must hold keys and values"),
        ("method: instant-ngp\ndataparser: {name: blendr}", "unknown data format 'blendr'. Did you mean 'blender'"),
        ("method: instant-ngp\ndataparser: {name: blender, nea: 1}", "unknown key 'nea'. Did you mean 'near'"),
    ],
)
def test_bad_recipes_are_refused_in_one_line(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "recipe.yml"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        read_run(path)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("sign", ["", "-"])
def test_numbers_of_more_digits_than_python_writes(tmp_path: Path, sign: str) -> None:
    path = tmp_path / "recipe.yml"
    refused = {"0x" + 5000 * "f": "a huge integer; it must be int", "1" + 300 * ":1" + ".0": "is not plain YAML"}
    for number, words in refused.items():
        path.write_text(f"method: instant-ngp\nmax_eval_images: {sign}{number}")
        with pytest.raises(ConfigError, match=words):
            read_run(path)


@pytest.mark.medium
def test_a_deeply_nested_recipe_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "recipe.yml"
    path.write_text("a: " + "[" * 5_000)
    error: Exception | None = None
    try:
        read_run(path)
    except Exception as caught:  # not pytest.raises: a thousand frames of a RecursionError take minutes to print
        error = caught
    assert type(error) is ConfigError


def test_a_few_lines_cannot_stand_for_more_than_memory_holds(tmp_path: Path) -> None:
    """Each name stands for nine of the one before: as a value, and as keys to be merged."""
    for first, many in (("[lol]", "[{}]"), ("{lol: 1}", "{{<<: [{}]}}")):
        lines = [f"a0: &a0 {first}"]
        lines += [f"a{n}: &a{n} {many.format(', '.join([f'*a{n - 1}'] * 9))}" for n in range(1, 40)]
        path = tmp_path / "recipe.yml"
        path.write_text("\n".join([*lines, "method: instant-ngp", "learning_rate: *a39"]))
        with pytest.raises(ConfigError, match="alias"):
            read_run(path)


def test_a_recipe_cannot_run_code(tmp_path: Path) -> None:
    path, proof = tmp_path / "recipe.yml", tmp_path / "proof"
    path.write_text(f"method: !!python/object/apply:os.system ['touch {proof}']")
    with pytest.raises(ConfigError, match="not plain YAML"):
        read_run(path)
    assert not proof.exists()


RECIPES = [p for p in (Path(__file__).parents[1] / "configs").glob("*.yml") if not p.name.startswith("compare-")]


@pytest.mark.parametrize("path", sorted(RECIPES), ids=lambda p: p.name)
def test_the_recipes_of_this_repository_load(path: Path) -> None:
    assert read_run(path).method in registered("methods")


# -- defaults changed by class keywords ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Settings(RayConfig, learning_rate=0.25, samples_per_batch=64, lr_schedule="cosine"):
    """Inherited settings with other defaults."""

    own: int = 3
    """A setting of its own."""


@dataclass(frozen=True)
class More(Settings, learning_rate=0.5, own=4):
    """The same once more."""


def test_class_keywords_change_defaults_and_nothing_else() -> None:
    assert (Settings().learning_rate, Settings().samples_per_batch, Settings().lr_schedule) == (0.25, 64, "cosine")
    assert (More().learning_rate, More().own, More().samples_per_batch) == (0.5, 4, 64)
    assert (RayConfig().learning_rate, RayConfig().samples_per_batch) == (5e-4, "auto")
    changed = {"learning_rate": 0.25, "samples_per_batch": 64, "lr_schedule": "cosine", "own": 3}
    assert to_plain(Settings()) == to_plain(RayConfig()) | changed


@pytest.mark.medium
def test_class_keywords_keep_type_order_and_help() -> None:
    hints, inherited = typing.get_type_hints(More), typing.get_type_hints(RayConfig)
    for name in ("learning_rate", "samples_per_batch", "lr_schedule"):
        assert hints[name] == inherited[name]
    assert hints["own"] is int
    names = [field.name for field in dataclasses.fields(RayConfig)]
    assert [field.name for field in dataclasses.fields(More)] == [*names, "own"]
    with pytest.raises(ConfigError, match="must be one of constant, exponential"):
        from_plain(More(), {"lr_schedule": "linear"}, "text")
    shown = io.StringIO()
    with pytest.raises(SystemExit), contextlib.redirect_stdout(shown):
        tyro.cli(More, args=["--help"])
    text = " ".join(shown.getvalue().replace("│", " ").split())
    assert "Initial learning rate of Adam. (default: 0.5)" in text
    assert "A setting of its own. (default: 4)" in text


def test_a_class_keyword_that_is_no_setting_is_refused() -> None:
    with pytest.raises(TypeError, match="Wrong inherits no setting 'learning_rat'"):

        class Wrong(TrainConfig, learning_rat=1.0):
            pass

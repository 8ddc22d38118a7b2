"""The commands as a person meets them: help, flags, files, errors in one line."""

import json
from pathlib import Path

import pytest
import yaml

from nerfloom.base.errors import ConfigError, DataError
from nerfloom.cli.train import run_of
from tests.cli.helpers import TINY_NGP, called


def test_help_lists_every_method() -> None:
    lines = called("ns-train", "--help").stdout.splitlines()
    for name in ("instant-ngp", "vanilla-nerf", "blender", "procedural"):
        assert sum(line.strip().startswith(name + " ") for line in lines) == 1


def test_method_help_shows_its_flags_without_prefix() -> None:
    done = called("ns-train", "vanilla-nerf", "--help-all")
    assert done.returncode == 0
    for flag in (
        "--sampler {hierarchical,occupancy,proposal,auto}",
        "--max-seconds",
        "--machine.seed",
        "--position-frequencies",
    ):
        assert flag in done.stdout
    assert "(default: 200000)" in " ".join(done.stdout.replace("│", " ").split())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["instant-npg"], "error: unknown method 'instant-npg'. Did you mean 'instant-ngp'?"),
        (["instant-ngp", "--data", "no/such/folder"], "error: --data no/such/folder: there is no such folder"),
        (["instant-ngp", "--data", "."], "error: --data .: the folder's format is unknown"),
        (["--load-config", "no.yml"], "error: cannot read no.yml: No such file or directory"),
        (["--data", "x"], "error: the method comes first, before --data"),
    ],
)
def test_errors_are_one_line(arguments: list[str], words: str, tmp_path: Path) -> None:
    done = called("ns-train", *arguments, folder=tmp_path)
    assert done.returncode == 1
    assert done.stderr.strip().startswith(words)
    assert len(done.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize("beside", [[], ["procedural"], ["--train-image-indices", "0", "1"]])
@pytest.mark.parametrize(
    ("flag", "value", "words"),
    [
        ("--max-seconds", "0", "--max-seconds is 0.0; it must be more than 0"),
        ("--num-levels", "99", "--num-levels is 99; it must be from 1 to 64"),
        ("--machine.seed", str(2**64), f"--machine.seed is {2**64}; it must be an integer of 64 bits"),
    ],
)
def test_a_flag_out_of_range_is_one_line(flag: str, value: str, words: str, beside: list[str]) -> None:
    """The flag stands in pairs of flags and values, beside a format's name, and beside a flag of several values."""
    done = called("ns-train", "instant-ngp", flag, value, *beside)
    assert done.returncode == 2
    assert done.stderr.strip() == f"error: {words}"


def test_damaged_data_is_one_line_and_debug_shows_more(tiny: Path, tmp_path: Path) -> None:
    (tiny / "transforms_train.json").write_text("{")
    arguments = ["instant-ngp", "--data", tiny, "--output-dir", tmp_path / "out"]
    done = called("ns-train", *arguments)
    assert done.returncode == 1
    assert "transforms_train.json is not JSON" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    with pytest.raises(DataError, match="is not JSON"):  # Python shows the traceback
        called("ns-train", *arguments, "--debug")
    assert not (tmp_path / "out").exists()


def parse(data: Path, *flags: str):
    return run_of("instant-ngp", ["--data", str(data), *flags])


def test_flags_in_any_order_and_the_format_by_name(shared_tiny: Path) -> None:
    plain = parse(shared_tiny)
    assert plain.dataparser == "blender"
    assert (plain.config.data, plain.config.mixed_precision) == (shared_tiny, None)
    many = [
        parse(shared_tiny, "--downscale-factor", "2", "--max-seconds", "3"),
        parse(shared_tiny, "--max-seconds", "3", "blender", "--downscale-factor", "2"),
        parse(shared_tiny, "blender", "--downscale-factor", "2", "--max-seconds", "3"),
    ]
    assert all(one.config == many[0].config and one.parser == many[0].parser for one in many)
    assert many[0].config.max_seconds == 3.0
    assert many[0].parser.downscale_factor == 2  # type: ignore[attr-defined]
    named = parse(shared_tiny, "--experiment-name", "blender", "blender", "--mixed-precision", "True")
    assert named.config.experiment_name == "blender"
    assert named.config.mixed_precision is True
    assert parse(shared_tiny, "--machine.seed", "7").config.machine.seed == 7


def test_the_folder_follows_the_names(shared_tiny: Path) -> None:
    run_ = parse(shared_tiny, "--output-dir", "o", "--timestamp", "now")
    assert run_.folder == Path("o") / shared_tiny.name / "instant-ngp" / "now"
    assert parse(shared_tiny, "--experiment-name", "e").folder.parts[:3] == ("outputs", "e", "instant-ngp")


def test_data_for_the_embedded_scene_is_refused(shared_tiny: Path, tmp_path: Path) -> None:
    done = called("ns-train", "instant-ngp", "--data", shared_tiny, "procedural", folder=tmp_path)
    assert done.returncode == 1
    assert "the embedded scene reads no data" in done.stderr


def test_a_missing_method_is_an_error() -> None:
    with pytest.raises(ConfigError, match="unknown method"):
        run_of("nerv", [])


@pytest.fixture(scope="module")
def finished(shared_tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished tiny run, through the command's entry point."""
    output = tmp_path_factory.mktemp("out")
    flags = ["--data", shared_tiny, "--output-dir", output, "--timestamp", "t", "--max-num-iterations", 60, *TINY_NGP]
    done = called("ns-train", "instant-ngp", *flags)
    assert done.returncode == 0, done.stderr
    return output / shared_tiny.name / "instant-ngp" / "t"


def test_the_run_folder(finished: Path) -> None:
    config = yaml.safe_load((finished / "config.yml").read_text())
    assert config["method"] == "instant-ngp"
    assert config["dataparser"]["name"] == "blender"
    transforms = json.loads((finished / "dataparser_transforms.json").read_text())
    assert [len(row) for row in transforms["transform"]] == [4, 4, 4]
    assert transforms["scale"] == 1.0
    assert (finished / "nerfstudio_models" / "step-000000060.ckpt").is_file()
    assert len(list((finished / "pictures").glob("*_comparison.png"))) == 3


def test_eval_repeats_the_numbers_of_training(finished: Path, tmp_path: Path) -> None:
    at_the_end = json.loads((finished / "eval.json").read_text())
    done = called(
        "ns-eval", "--load-config", finished / "config.yml", "--output-path", tmp_path / "o.json",
        "--render-output-path", tmp_path / "renders",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    again = json.loads((tmp_path / "o.json").read_text())
    assert {"experiment_name", "method_name", "checkpoint", "results"} <= again.keys()
    expected = {"psnr", "psnr_std", "ssim", "ssim_std", "lpips", "lpips_std", "num_rays_per_sec", "fps"}
    assert expected <= again["results"].keys()
    for key in ("psnr", "psnr_std", "ssim", "ssim_std", "lpips"):
        assert again["results"][key] == at_the_end["results"][key]
    assert again["checkpoint"] == "step-000000060.ckpt"
    assert [row["name"] for row in again["per_image"]] == ["r_0.png", "r_1.png", "r_2.png"]
    assert again["results"]["lpips"] is None or again["lpips"].startswith("alex, ")
    assert len(list((tmp_path / "renders").glob("*.png"))) == 9


def test_a_moved_run_and_moved_data(finished: Path, tiny: Path, tmp_path: Path) -> None:
    import shutil

    moved = tmp_path / "elsewhere"
    shutil.copytree(finished, moved)
    done = called("ns-eval", "--load-config", moved / "config.yml", "--data", tiny, "--max-images", 1)
    assert done.returncode == 0, done.stderr
    assert json.loads((moved / "eval.json").read_text())["results"]["num_images"] == 1


def test_eval_without_a_checkpoint(finished: Path, tmp_path: Path) -> None:
    (tmp_path / "config.yml").write_text((finished / "config.yml").read_text())
    done = called("ns-eval", "--load-config", tmp_path / "config.yml")
    assert done.returncode == 1
    assert "holds no checkpoint" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_orbit(finished: Path, tmp_path: Path) -> None:
    from PIL import Image

    output = tmp_path / "orbit.gif"
    done = called(
        "ns-render", "orbit", "--load-config", finished / "config.yml", "--output-path", output, "--num-frames", 5
    )
    assert done.returncode == 0, done.stderr
    with Image.open(output) as animation:
        assert (animation.n_frames, animation.size) == (5, (20, 20))
    assert called("ns-render", "orbi").stderr.startswith("error: unknown path 'orbi'. Did you mean 'orbit'?")


@pytest.mark.medium
def test_a_recipe_with_overrides_and_resuming(shared_tiny: Path, tmp_path: Path) -> None:
    recipe = tmp_path / "recipe.yml"
    names = [flag[2:].replace("-", "_") for flag in TINY_NGP[::2]]
    settings = dict(zip(names, map(yaml.safe_load, TINY_NGP[1::2]), strict=True))
    recipe.write_text(yaml.safe_dump({"method": "instant-ngp", "max_num_iterations": 99, **settings}))
    flags = ["--data", shared_tiny, "--output-dir", tmp_path, "--timestamp", "r", "--max-eval-images", 0]
    done = called("ns-train", "--load-config", recipe, *flags, "--max-num-iterations", 5)
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "ball" / "instant-ngp" / "r"
    assert (folder / "nerfstudio_models" / "step-000000005.ckpt").is_file()
    done = called("ns-train", "--resume", folder, "--max-num-iterations", 8)
    assert done.returncode == 0, done.stderr
    assert "at step 5" in done.stderr
    assert (folder / "nerfstudio_models" / "step-000000008.ckpt").is_file()

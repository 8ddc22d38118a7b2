"""ns-train on bad input, damaged files and recipes: one line with the fault, the place and advice."""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml

from nerfloom.cli.train import main, run_of
from nerfloom.registry import load_method
from nerfloom.training.run import Run, create_folder
from tests.cli.helpers import TINY_NGP, called, run
from tests.conftest import Refused
from tests.training.helpers import tiny_run, tiny_trainer

Capture = pytest.CaptureFixture[str]


def change(data: Path, edit: Callable[[dict], object]) -> None:
    file = data / "transforms_train.json"
    content = json.loads(file.read_text())
    edit(content)
    file.write_text(json.dumps(content))


def damage_images(data: Path, content: bytes | None) -> None:
    for file in (data / "train").glob("*.png"):
        file.unlink() if content is None else file.write_bytes(content)


DAMAGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "not JSON": (lambda d: (d / "transforms_train.json").write_text("{"), "transforms_train.json is not JSON"),
    "a list": (lambda d: (d / "transforms_train.json").write_text("[]"), "must contain a JSON object"),
    "deep": (lambda d: (d / "transforms_train.json").write_text("[" * 100_000), "transforms_train.json is not JSON"),
    "no frames": (lambda d: change(d, lambda c: c.update(frames=[])), "transforms_train.json lists no frames"),
    "no angle": (lambda d: change(d, lambda c: c.pop("camera_angle_x")), "there is no focal length"),
    "no file": (lambda d: change(d, lambda c: c["frames"][2].pop("file_path")), "frame 2: 'file_path' is missing"),
    "nan pose": (
        lambda d: change(d, lambda c: c["frames"][2]["transform_matrix"][0].__setitem__(0, np.nan)),
        "frame 2: the pose holds a value that is not finite",
    ),
    "no image": (
        lambda d: damage_images(d, None),
        "split 'train' has no image: none of the 10 files listed in the data exists",
    ),
    "no readable image": (lambda d: damage_images(d, b"text"), "r_0.png is not a readable image"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_data_is_one_line(name: str, tiny: Path, tmp_path: Path, refused: Refused) -> None:
    spoil, words = DAMAGE[name]
    spoil(tiny)
    assert words in refused(main, "instant-ngp", "--data", tiny, "--output-dir", tmp_path / "out", *TINY_NGP)
    assert not (tmp_path / "out").exists()


def test_a_misspelt_data_format_gets_the_nearest(shared_tiny: Path) -> None:
    done = called("ns-train", "instant-ngp", "--data", shared_tiny, "blendr")
    assert done.returncode != 0
    assert "Traceback" not in done.stderr
    assert "blendr" in done.stderr
    assert "'blender'" in done.stderr


def test_a_file_in_the_way_of_the_output(shared_tiny: Path, tmp_path: Path) -> None:
    (tmp_path / "out").write_text("a file")
    done = called("ns-train", "instant-ngp", "--data", shared_tiny, "--output-dir", tmp_path / "out", *TINY_NGP)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith(f"error: cannot write the run's folder {tmp_path / 'out'}")
    assert (tmp_path / "out").read_text() == "a file"


def test_a_run_is_never_overwritten(shared_tiny: Path, tmp_path: Path, refused: Refused) -> None:
    folder = tmp_path / "ball" / "instant-ngp" / "t"
    create_folder(tiny_run("instant-ngp", shared_tiny, folder))
    before = (folder / "config.yml").read_text()
    said = refused(main, "instant-ngp", "--data", shared_tiny, "--output-dir", tmp_path, "--timestamp", "t", *TINY_NGP)
    assert f"ns-train --resume {folder}" in said
    assert (folder / "config.yml").read_text() == before


def test_a_damaged_checkpoint_to_start_from(shared_tiny: Path, tmp_path: Path, refused: Refused) -> None:
    broken = tmp_path / "broken.ckpt"
    broken.write_bytes(b"PK\x03\x04 and then nothing")
    said = refused(
        main, "instant-ngp", "--data", shared_tiny, "--output-dir", tmp_path / "out", "--timestamp", "t",
        "--load-checkpoint", broken, *TINY_NGP,
    )  # fmt: skip
    assert f"{broken} is damaged or not a checkpoint" in said
    assert not list((tmp_path / "out").rglob("config.yml")), "a run that never began must not take the folder"


def write_recipe(path: Path, **values: object) -> Path:
    path.write_text(yaml.safe_dump({"method": "instant-ngp", **values}))
    return path


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("method: instant-ngp\nlearning_rat: 1", "unknown key 'learning_rat'. Did you mean 'learning_rate'"),
        ("method: instant-ngp\nmax_num_iterations: many", "'max_num_iterations' is 'many'; it must be int"),
        ("method: [", "is not plain YAML"),
        ("method: nerv", "unknown method 'nerv'"),
    ],
)
def test_bad_recipes_are_one_line(text: str, words: str, tmp_path: Path, refused: Refused) -> None:
    (tmp_path / "recipe.yml").write_text(text)
    assert words in refused(main, "--load-config", tmp_path / "recipe.yml")


def test_a_recipe_that_would_run_code_does_not(tmp_path: Path) -> None:
    recipe, proof = tmp_path / "recipe.yml", tmp_path / "proof"
    recipe.write_text(f"method: !!python/object/apply:os.system ['touch {proof}']")
    done = called("ns-train", "--load-config", recipe)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert done.stderr.startswith(f"error: {recipe} is not plain YAML")
    assert not proof.exists()


def test_a_recipe_for_another_method(shared_tiny: Path, tmp_path: Path, refused: Refused) -> None:
    recipe = write_recipe(tmp_path / "r.yml", data=str(shared_tiny))
    said = refused(main, "vanilla-nerf", "--load-config", recipe)
    assert f"{recipe} is for instant-ngp, not for vanilla-nerf" in said


def started(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> Run:
    """The run that a command line would start."""
    runs: list[Run] = []
    monkeypatch.setattr("nerfloom.cli.session.start", runs.append)
    monkeypatch.setattr(sys, "argv", ["ns-train", *map(str, arguments)])
    main()
    return runs[0]


def test_the_command_line_beats_the_recipe_wherever_it_stands(
    shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = write_recipe(
        tmp_path / "r.yml", data=str(shared_tiny), max_seconds=3.0, hidden_width=32,
        dataparser={"name": "blender", "downscale_factor": 2},
    )  # fmt: skip
    orders = [
        ["--load-config", recipe, "--max-seconds", 7],
        ["--max-seconds", 7, "--load-config", recipe],
        ["instant-ngp", "--max-seconds", 7, f"--load-config={recipe}"],
    ]
    for arguments in orders:
        one = started(monkeypatch, *arguments)
        assert (one.config.max_seconds, one.config.data) == (7.0, shared_tiny)
        assert one.config.hidden_width == 32  # type: ignore[attr-defined]
        assert one.parser.downscale_factor == 2  # type: ignore[attr-defined]


def test_booleans_are_spelt_out(shared_tiny: Path) -> None:
    def parse(*flags: str) -> Run:
        return run_of("instant-ngp", ["--data", str(shared_tiny), *flags])

    for word, value in (("True", True), ("False", False)):
        assert parse("--mixed-precision", word).config.mixed_precision is value
        assert parse("--save-only-latest-checkpoint", word).config.save_only_latest_checkpoint is value
    assert parse("--mixed-precision", "None").config.mixed_precision is None


def test_the_folder_is_dated(shared_tiny: Path) -> None:
    folder = run_of("vanilla-nerf", ["--data", str(shared_tiny)]).folder
    assert folder.parts[:3] == ("outputs", shared_tiny.name, "vanilla-nerf")
    assert re.fullmatch(r"\d{4}-\d\d-\d\d_\d{6}", folder.name)


def test_help_of_a_method_states_its_own_defaults(shared_tiny: Path) -> None:
    said = " ".join(called("ns-train", "instant-ngp", "--data", shared_tiny, "--help-all").stdout.split())
    config = load_method("instant-ngp").config
    assert f"(default: {config.max_num_iterations})" in said
    for flag in ("--num-levels", "--log2-table-size", "--downscale-factor", "--mixed-precision"):
        assert f" {flag} " in said or f"{flag} {{" in said
    assert "--method." not in said


@pytest.mark.parametrize("flag", ["--help", "--version"])
def test_what_answers_at_once_imports_little(flag: str) -> None:
    """rich is the only other package imported; torch or a method would take a second."""
    code = "import sys; from nerfloom.cli.train import main; main(); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code, flag], capture_output=True, text=True, check=True)
    imported = set(done.stdout.splitlines()[-1].split())
    others = {name.partition(".")[0] for name in imported} - sys.stdlib_module_names
    assert {name for name in others if not name.startswith("_")} == {"nerfloom", "rich"}
    assert not {"nerfloom.methods", "nerfloom.dataparsers", "nerfloom.model"} & imported


def test_resuming_nothing(tmp_path: Path, refused: Refused) -> None:
    assert f"cannot read {tmp_path / 'gone'}: No such file" in refused(main, "--resume", tmp_path / "gone")


@pytest.mark.medium
def test_resuming_from_damaged_checkpoints(
    shared_tiny: Path, tmp_path: Path, refused: Refused, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    """The newest is cut short: the one before is taken, and the command says so. Both: an error."""
    folder = tmp_path / "run"
    steps = {"max_num_iterations": 6, "steps_per_save": 3, "max_eval_images": 0}
    tiny_trainer("instant-ngp", shared_tiny, folder, **steps).train()
    older, newer = (folder / "nerfstudio_models" / f"step-00000000{step}.ckpt" for step in (3, 6))
    newer.write_bytes(newer.read_bytes()[:1000])
    monkeypatch.setattr(sys, "argv", ["ns-train", "--resume", str(folder)])
    main()
    said = capsys.readouterr().err
    assert f"{newer} is damaged" in said
    assert f"resuming {folder} at step 3" in said
    older.write_bytes(b"")
    newer.write_bytes(b"")
    assert "none of the 2 checkpoints" in refused(main, "--resume", folder)


def test_pictures_too_small_for_ssim_end_well(
    shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    arguments = ["instant-ngp", "--data", shared_tiny, "--output-dir", tmp_path, "--timestamp", "t", *TINY_NGP]
    arguments += ["--max-num-iterations", 3, "--downscale-factor", 2]
    monkeypatch.setattr(sys, "argv", ["ns-train", *map(str, arguments)])
    main()
    results = json.loads((tmp_path / "ball" / "instant-ngp" / "t" / "eval.json").read_text())["results"]
    assert results["ssim"] is None
    said = capsys.readouterr().err
    assert "images of 10 x 10" in said
    assert "SSIM absent" in said


@pytest.mark.slow
def test_without_data_the_embedded_scene_is_trained(tmp_path: Path) -> None:
    flags = ["--max-num-iterations", 5, "--output-dir", tmp_path, "--timestamp", "t", *TINY_NGP]
    done = run("ns-train", "instant-ngp", *flags, "procedural", "--size", 16, "--num-train", 4)
    assert done.returncode == 0, done.stderr
    config = yaml.safe_load((tmp_path / "procedural" / "instant-ngp" / "t" / "config.yml").read_text())
    assert config["dataparser"]["size"] == 16
    assert config["data"] is None


def test_flags_in_pairs_mean_the_same_as_beside_a_formats_name(
    shared_tiny: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flags = ("--max-seconds", 5, "--downscale-factor=2", "--machine.seed", 3)
    runs = [
        started(monkeypatch, "instant-ngp", "--data", shared_tiny, *flags),
        started(monkeypatch, "instant-ngp", *flags, f"--data={shared_tiny}"),
        started(monkeypatch, "instant-ngp", "--data", shared_tiny, *flags, "blender"),
        started(monkeypatch, "instant-ngp", "--data", shared_tiny, *flags, "--train-image-indices", 0, 1),
    ]
    assert len({(run.config.data, run.dataparser, run.parser, run.config.max_seconds) for run in runs}) == 1
    assert runs[0].config == runs[1].config == runs[2].config
    assert runs[3].config.train_image_indices == (0, 1)
    assert started(monkeypatch, "instant-ngp", "--data", "None").dataparser == "procedural"

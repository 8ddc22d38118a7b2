"""Commands of nerfstudio's users: the answer names the equivalent in a line, and nothing of theirs is run."""

from dataclasses import fields, is_dataclass
from pathlib import Path

import pytest

from nerfloom.base.from_nerfstudio import (
    CAMERA_SETTINGS,
    FORMATS,
    KINDS,
    NO_FORMATS,
    SETTINGS,
    SPELLINGS,
    TAKEN,
    config_answer,
    flag_answer,
    format_answer,
    taken,
)
from nerfloom.cli.export import KINDS as EXPORTS
from nerfloom.cli.train import _flag_names, main, run_of
from nerfloom.processing.kinds import KINDS as INPUTS
from nerfloom.registry import load_dataparser, load_method, registered
from nerfloom.video.settings import PATHS
from tests.conftest import Refused


def test_every_flag_that_is_named_exists() -> None:
    settings = [load_method(name).config for name in registered("methods")]
    settings += [load_dataparser(name)() for name in registered("dataparsers")]  # type: ignore[list-item]
    known = {flag for value in settings if is_dataclass(value) and fields(value) for flag in _flag_names(value)}
    assert {*SETTINGS.values(), *CAMERA_SETTINGS.values(), *SPELLINGS.values()} <= known
    assert {SETTINGS.get(name, f"--{name}") for name in TAKEN} <= known
    assert set(FORMATS.values()) <= set(registered("dataparsers"))
    assert not {*FORMATS, *NO_FORMATS} & set(registered("dataparsers"))
    assert not set(KINDS) & {*PATHS, *EXPORTS, *INPUTS}


@pytest.mark.parametrize(
    ("flags", "answer"),
    [
        (["--pipeline.model.near-plane", "0.1"], "here it is --near"),
        (["--pipeline.model.hidden-dim", "64"], "here it is --hidden-width"),
        (["--pipeline.model.sh-degree", "2"], "there is no equivalent flag"),
        (["--pipeline.model.num-nerf-sample", "8"], "the nearest is --num-nerf-samples"),
        (
            ["--pipeline.model.collider-params", "1"],
            "there is no equivalent flag; ns-train nerfacto --help-all lists all flags",
        ),
        (["--optimizers.fields.optimizer.lr", "1e-3"], "here it is --learning-rate"),
        (["--optimizers.camera-opt.optimizer.lr", "1e-3"], "here it is --camera-learning-rate"),
        (["--viewer.quit-on-train-completion", "True"], "--viewer.websocket-host"),
        (["--vis", "viewer+wandb"], "nerfstudio's; leave it out; the choice here is --vis viewer, tensorboard"),
        (["--machine.num-devices", "2"], "torchrun starts several"),
        (["--load-step", "1000"], "here it is --load-checkpoint"),
        (["nuscenes-data"], "is not supported here"),
    ],
)
def test_flags_and_formats(flags: list[str], answer: str, shared_tiny: Path, refused: Refused) -> None:
    status = 2 if flags[0].startswith("--") else 1
    said = refused(main, "nerfacto", "--data", shared_tiny, *flags, status=status)
    assert "is nerfstudio's" in said
    assert answer in said


@pytest.mark.parametrize(
    ("method", "flags", "setting", "value"),
    [
        ("gaussian-splatting", ["--pipeline.model.sh-degree", "2"], "degree", 2),
        ("gaussian-splatting", ["--pipeline.model.sh_degree=1"], "degree", 1),
        ("gaussian-splatting", ["--pipeline.model.max-gs-num", "500"], "num_gaussians", 500),
        ("nerfacto", ["--max-iters", "70"], "max_num_iterations", 70),
        ("nerfacto", ["--iterations=70"], "max_num_iterations", 70),
        ("nerfacto", ["--trainer.max-num-iterations", "3"], "max_num_iterations", 3),
        ("nerfacto", ["--pipeline.model.camera-optimizer.mode", "off"], "camera_optimizer", "off"),
        ("nerfacto", ["--pipeline.model.max_res=4096"], "max_resolution", 4096),
        ("nerfacto", ["--pipeline.model.predict-normals", "True"], "predict_normals", True),
        ("nerfacto", ["--pipeline.model.num-proposal-samples-per-ray", "64", "32"], "num_proposal_samples", (64, 32)),
        ("nerfacto", ["--pipeline.datamanager.train-num-rays-per-batch", "64"], "num_rays_per_batch", 64),
    ],
)
def test_what_means_the_same_is_taken_and_said(
    method: str, flags: list[str], setting: str, value: object, tiny: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = run_of(method, ["--data", str(tiny), "--max-seconds", "60", *flags])
    assert getattr(run.config, setting) == value
    assert f"{flags[0].partition('=')[0]} is taken as --{setting.replace('_', '-')}" in capsys.readouterr().err
    assert run.config.max_num_iterations == (value if setting == "max_num_iterations" else None)


def test_formats_and_their_flags_are_taken(tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """nerfstudio's order is accepted too: the format before --data."""
    scaled = ["--pipeline.datamanager.dataparser.downscale-factor", "2"]
    run = run_of("nerfacto", ["blender-data", "--data", str(tiny), *scaled])
    assert (run.dataparser, getattr(run.parser, "downscale_factor")) == ("blender", 2)  # noqa: B009
    said = capsys.readouterr().err
    assert "blender-data is taken as blender" in said
    assert "is taken as --downscale-factor" in said
    assert run_of("nerfacto", ["--source-path", str(tiny)]).config.data == tiny


def test_words_that_are_ours_or_values_stay(tiny: Path) -> None:
    words = ["--iterations", "5", "--experiment-name", "blender-data", "--max-iters"]
    assert taken(words, {"--iterations", "--max-num-iterations"})[0] == [*words[:4], "--max-num-iterations"]
    assert taken(["--sh-degree", "2"], {"--learning-rate"}) == (["--sh-degree", "2"], [])
    assert taken(["--optimizers.fields.optimizer.lr-final", "1e-4"], {"--lr-final"})[1] == []


def test_our_own_flags_are_no_one_elses() -> None:
    known = set(_flag_names(load_method("nerfacto").config))
    assert "--machine.seed" in known
    assert [flag for flag in known if flag_answer(flag, "nerfacto", known) is not None] == []
    assert flag_answer("--max-secnds", "nerfacto", known) is None
    assert format_answer("blendr") is None


CONFIG = """!!python/object:nerfstudio.engine.trainer.TrainerConfig
_target: !!python/name:nerfstudio.engine.trainer.Trainer ''
data: &id003 !!python/object/apply:pathlib.PosixPath
- /
- data
- 'my lego'
method_name: nerfacto
relative_model_dir: !!python/object/apply:os.system ['touch {proof}']
"""


def test_its_config_is_recognised_and_never_loaded(tmp_path: Path, refused: Refused) -> None:
    proof = tmp_path / "proof"
    (tmp_path / "config.yml").write_text(CONFIG.format(proof=proof))
    for flags in (("--load-config", tmp_path / "config.yml"), ("--resume", tmp_path)):
        said = refused(main, *flags)
        assert f"{tmp_path / 'config.yml'} is nerfstudio's" in said
        assert said.endswith("ns-train nerfacto --data '/data/my lego'")
    assert not proof.exists()
    assert config_answer("method: instant-ngp\n") is None
    assert str(config_answer("!!python/object:nerfstudio.x\n")).endswith("ns-train METHOD --data DIR")

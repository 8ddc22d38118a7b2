"""What users of nerfstudio type: answered with what is there, in a line, and nothing of theirs is run."""

from dataclasses import fields, is_dataclass
from pathlib import Path

import pytest

from framework.base.from_nerfstudio import (
    CAMERA_SETTINGS,
    FORMATS,
    KINDS,
    NO_FORMATS,
    SETTINGS,
    config_answer,
    flag_answer,
    format_answer,
)
from framework.base.registry import load_dataparser, load_method, registered
from framework.cli.export import KINDS as EXPORTS
from framework.cli.process_data import KINDS as INPUTS
from framework.cli.render import PATHS
from framework.cli.train import _flag_names, main
from tests.conftest import Refused


def test_every_flag_that_is_named_exists() -> None:
    settings = [load_method(name).config for name in registered("methods")]
    settings += [load_dataparser(name)() for name in registered("dataparsers")]  # type: ignore[list-item]
    known = {flag for value in settings if is_dataclass(value) and fields(value) for flag in _flag_names(value)}
    assert {*SETTINGS.values(), *CAMERA_SETTINGS.values()} <= known
    assert set(FORMATS.values()) <= set(registered("dataparsers"))
    assert not {*FORMATS, *NO_FORMATS} & set(registered("dataparsers"))
    assert not set(KINDS) & {*PATHS, *EXPORTS, *INPUTS}


@pytest.mark.parametrize(
    ("flags", "answer"),
    [
        (["--pipeline.model.camera-optimizer.mode", "off"], "here it is --camera-optimizer"),
        (["--pipeline.model.max_res=4096"], "here it is --max-resolution"),
        (["--pipeline.model.predict-normals", "True"], "here it is --predict-normals"),
        (["--pipeline.model.near-plane", "0.1"], "here it is --near"),
        (
            ["--pipeline.model.collider-params", "1"],
            "there is no equivalent flag; ns-train nerfacto --help lists all flags",
        ),
        (["--pipeline.datamanager.train-num-rays-per-batch", "64"], "here it is --num-rays-per-batch"),
        (["--pipeline.datamanager.dataparser.downscale-factor", "2"], "here it is --downscale-factor"),
        (["--optimizers.fields.optimizer.lr", "1e-3"], "here it is --learning-rate"),
        (["--optimizers.camera-opt.optimizer.lr", "1e-3"], "here it is --camera-learning-rate"),
        (["--trainer.max-num-iterations", "3"], "here it is --max-num-iterations"),
        (["--viewer.quit-on-train-completion", "True"], "there are --viewer.websocket-host"),
        (["--vis", "viewer+wandb"], "nerfstudio's; leave it out; the choice here is --vis viewer, tensorboard"),
        (["--machine.num-devices", "2"], "torchrun starts several"),
        (["--load-step", "1000"], "here it is --load-checkpoint"),
        (["blender-data"], "here the data format is called 'blender'"),
        (["nuscenes-data"], "is not supported here"),
    ],
)
def test_flags_and_formats(flags: list[str], answer: str, shared_tiny: Path, refused: Refused) -> None:
    status = 2 if flags[0].startswith("--") else 1
    said = refused(main, "nerfacto", "--data", shared_tiny, *flags, status=status)
    assert "is nerfstudio's" in said
    assert answer in said


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

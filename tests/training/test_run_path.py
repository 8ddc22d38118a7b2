"""Paths of a run: its folder, its settings, or a folder above it, which stands for its newest run."""

import os
from pathlib import Path

import pytest

from nerfloom.base.errors import CheckpointError, ConfigError
from nerfloom.cli.train_paths import check_paths
from nerfloom.training.run_path import config_file, trained_run


def make_run(folder: Path, age: float, trained: bool) -> Path:
    """The folder of a run that started `age` seconds ago."""
    (folder / "nerfstudio_models").mkdir(parents=True)
    config = folder / "config.yml"
    config.write_text("method: instant-ngp\n")
    os.utime(config, (1e9 - age, 1e9 - age))
    if trained:
        (folder / "nerfstudio_models" / "step-000000007.ckpt").touch()
    return config


def test_the_newest_run_with_a_checkpoint_below_any_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    old = make_run(tmp_path / "cup" / "nerfacto" / "a", 300, True)
    new = make_run(tmp_path / "cup" / "kplanes" / "b", 200, True)
    make_run(tmp_path / "fox" / "nerfacto" / "c", 100, False)
    assert config_file(old) == config_file(old.parent) == old
    assert capsys.readouterr().err == ""
    assert config_file(tmp_path) == new
    said = f"the newest of 3 runs in {tmp_path}: {new.parent}; 1 later has no checkpoint\n"
    assert capsys.readouterr().err == said
    assert config_file(tmp_path / "cup" / "nerfacto") == old
    assert trained_run(tmp_path / "cup") == new
    assert config_file(tmp_path / "fox").parent.name == "c"
    with pytest.raises(CheckpointError, match="holds no checkpoint"):
        trained_run(tmp_path / "fox")


def test_what_is_missing_is_named_with_the_nearest_that_is_there(tmp_path: Path) -> None:
    make_run(tmp_path / "cup" / "nerfacto" / "2026-01-02_030405", 0, True)
    with pytest.raises(ConfigError, match=r"cannot read .*Did you mean '2026-01-02_030405'\? \(in .*nerfacto\)"):
        config_file(tmp_path / "cup" / "nerfacto" / "2026-01-02_030406")
    with pytest.raises(ConfigError, match=r"Did you mean 'nerfacto'\? \(in .*cup\)"):
        config_file(tmp_path / "cup" / "nerfato" / "2026-01-02_030405")
    checkpoint = tmp_path / "cup" / "nerfacto" / "2026-01-02_030405" / "nerfstudio_models" / "step-000000007.ckpt"
    with pytest.raises(ConfigError, match=r"is a checkpoint; name its run, such as .*/2026-01-02_030405, and"):
        config_file(checkpoint)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="there is no run below it"):
        config_file(tmp_path / "empty")


@pytest.mark.parametrize(
    "flags",
    [
        [],
        ["--data", "None"],
        ["--experiment-name", "--data"],
        ["--data", "here"],
        ["--data", "nowhere", "--data=here"],
        ["--data", "nowhere", "--help"],
    ],
)
def test_paths_that_are_there_or_not_given_pass(
    flags: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "here").mkdir()
    check_paths(flags)
    assert [path.name for path in tmp_path.iterdir()] == ["here"]


@pytest.mark.parametrize("flags", [["--output_dir=file/below"], ["--output-dir", "file"]])
def test_a_folder_below_a_file_is_refused(flags: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"cannot write .*file.*: Not a directory"):
        check_paths(flags)

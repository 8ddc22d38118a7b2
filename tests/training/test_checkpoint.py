"""Checkpoints: whole or not at all, and never code."""

import errno
import pickle
import zipfile
from pathlib import Path

import pytest
import torch

from nerfloom.base.errors import CheckpointError
from nerfloom.training import checkpoint
from nerfloom.training.checkpoint import list_checkpoints, load_checkpoint, load_newest, save_checkpoint
from tests.training.helpers import Malicious


def save(folder: Path, step: int, keep_all: bool = False, before: int | None = None) -> Path:
    return save_checkpoint(folder, step, {"model": {"w": torch.full((50,), float(step))}}, keep_all, before)


def test_the_two_newest_are_kept(tmp_path: Path) -> None:
    for step in (1, 2, 30):
        path = save(tmp_path, step)
    assert path.name == "step-000000030.ckpt"
    assert [p.name for p in list_checkpoints(tmp_path)] == ["step-000000002.ckpt", "step-000000030.ckpt"]
    assert load_checkpoint(path)["model"]["w"][0] == 30
    save(tmp_path, 31, keep_all=True)
    assert len(list_checkpoints(tmp_path)) == 3


def test_a_damaged_later_one_pushes_nothing_out(tmp_path: Path) -> None:
    """A run went on from step 2, because later checkpoints cannot be read."""
    paths = [save(tmp_path, step, keep_all=True) for step in (1, 2, 8, 9)]
    for path in paths[2:]:
        path.write_bytes(b"damaged")
    for step in (3, 4):
        save(tmp_path, step)
        state = load_newest(tmp_path)
        assert state is not None
        assert state["model"]["w"][0] == step
    names = [int(path.stem[5:]) for path in list_checkpoints(tmp_path)]
    assert names == [3, 4, 8, 9]
    save(tmp_path, 9)
    assert [int(path.stem[5:]) for path in list_checkpoints(tmp_path)] == [8, 9]


def test_the_one_that_stays_can_be_read(tmp_path: Path) -> None:
    """A run went on from step 4, because checkpoint 8 is damaged; past step 8, the damaged one is deleted."""
    for step in (2, 4, 8):
        save(tmp_path, step, keep_all=True)
    (tmp_path / "step-000000008.ckpt").write_bytes(b"damaged")
    newest = save(tmp_path, 9, before=4)
    assert [int(path.stem[5:]) for path in list_checkpoints(tmp_path)] == [4, 9]
    newest.write_bytes(b"damaged")
    state = load_newest(tmp_path)
    assert state is not None
    assert state["model"]["w"][0] == 4
    save(tmp_path, 10, before=7)  # there is none
    assert [int(path.stem[5:]) for path in list_checkpoints(tmp_path)] == [9, 10]


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.99])
def test_one_cut_short_falls_back_to_the_one_before(
    tmp_path: Path, keep: float, capsys: pytest.CaptureFixture[str]
) -> None:
    save(tmp_path, 1)
    newest = save(tmp_path, 2)
    whole = newest.read_bytes()
    newest.write_bytes(whole[: int(len(whole) * keep)])
    state = load_newest(tmp_path)
    assert state is not None
    assert state["model"]["w"][0] == 1
    assert "step-000000002.ckpt is damaged" in capsys.readouterr().err
    with pytest.raises(CheckpointError, match="damaged"):
        load_checkpoint(newest)
    (tmp_path / "step-000000001.ckpt").write_bytes(b"")
    with pytest.raises(CheckpointError, match="none of the 2 checkpoints"):
        load_newest(tmp_path)


def test_no_byte_may_change(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """This holds above all for the bytes of a tensor, because torch does not check them."""
    save(tmp_path, 1)
    newest = save(tmp_path, 2)
    whole = newest.read_bytes()
    tensor = whole.index(torch.full((50,), 2.0).numpy().tobytes())
    places = [0, tensor, tensor + 100, *range(10, len(whole), len(whole) // 40), *range(len(whole) - 80, len(whole), 3)]
    for place in places:
        newest.write_bytes(whole[:place] + bytes([whole[place] ^ 0x10]) + whole[place + 1 :])
        with pytest.raises(CheckpointError, match=r"step-000000002\.ckpt is damaged"):
            load_checkpoint(newest)
        state = load_newest(tmp_path)
        assert state is not None
        assert state["model"]["w"][0] == 1
        said = " ".join(capsys.readouterr().err.split())
        assert "step-000000002.ckpt is damaged" in said
        assert "trying the previous one" in said


def test_a_sealed_one_is_still_what_torch_writes(tmp_path: Path) -> None:
    assert torch.load(save(tmp_path, 3), weights_only=True)["model"]["w"][0] == 3


@pytest.mark.parametrize("number", [torch.zeros(2), "2", None, 2.0, [2]])
def test_a_format_that_is_no_number(tmp_path: Path, number: object) -> None:
    torch.save({"format": number, "model": {}}, tmp_path / "a.ckpt")
    with pytest.raises(CheckpointError, match="not a checkpoint of this version"):
        load_checkpoint(tmp_path / "a.ckpt")


def test_missing_and_foreign_files(tmp_path: Path) -> None:
    assert load_newest(tmp_path) is None
    with pytest.raises(CheckpointError, match="there is no checkpoint"):
        load_checkpoint(tmp_path / "step-000000001.ckpt")
    torch.save({"format": 99, "model": {}}, tmp_path / "a.ckpt")
    with pytest.raises(CheckpointError, match="not a checkpoint of this version"):
        load_checkpoint(tmp_path / "a.ckpt")


def test_a_checkpoint_cannot_run_code(tmp_path: Path) -> None:
    for name, write in (("a.ckpt", torch.save), ("b.ckpt", lambda o, p: p.write_bytes(pickle.dumps(o)))):
        write({"format": 1, "model": Malicious(tmp_path / "proof")}, tmp_path / name)
        with pytest.raises(CheckpointError):
            load_checkpoint(tmp_path / name)
    assert not (tmp_path / "proof").exists()


def test_one_that_would_unfold_to_more_than_it_holds_is_refused(tmp_path: Path) -> None:
    """torch unpacks compressed files too: 10 kB may stand for 10 MB, and 10 MB for more than memory has."""
    path = save(tmp_path, 1)
    with zipfile.ZipFile(path) as stored, zipfile.ZipFile(tmp_path / "bomb.ckpt", "w", zipfile.ZIP_DEFLATED) as packed:
        for name in stored.namelist():
            packed.writestr(name, stored.read(name))
        packed.writestr("archive/data/9", bytes(10**7))
    assert (tmp_path / "bomb.ckpt").stat().st_size < 10**5
    with pytest.raises(CheckpointError, match="its uncompressed size is larger than the file"):
        load_checkpoint(tmp_path / "bomb.ckpt")


def test_a_full_disk_leaves_the_old_one_and_no_rubbish(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save(tmp_path, 1)

    def full(content: object, file: object) -> None:
        file.write(b"x" * 1000)  # type: ignore[attr-defined]
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(CheckpointError, match="No space left on device"):
        save(tmp_path, 2)
    assert [p.name for p in tmp_path.iterdir()] == ["step-000000001.ckpt"]
    assert load_checkpoint(tmp_path / "step-000000001.ckpt")["model"]["w"][0] == 1


@pytest.mark.parametrize(("version", "warned"), [("2.9.1+cpu", True), ("2.10.0", False), ("2.13.0+cpu", False)])
def test_an_older_torch_is_warned_of_once(
    version: str, warned: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = save(tmp_path, 1)
    monkeypatch.setattr(torch, "__version__", version)
    checkpoint._warn_of.cache_clear()
    for _ in range(2):
        assert load_checkpoint(path)["model"]["w"][0] == 1
    assert capsys.readouterr().err.count("CVE-2026-24747") == int(warned)

"""ns-eval: its numbers against the pictures it writes, and its errors."""

import json
import pickle
import shutil
import statistics
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
import torch
import yaml
from PIL import Image
from torch import Tensor

from nerfloom.cameras.view import View
from nerfloom.cli.evaluate import main
from nerfloom.ray_model import RayModel
from nerfloom.rendering.rendered import Picture
from tests.cli.helpers import called, train
from tests.conftest import Refused
from tests.training.helpers import Malicious

RAYS = ("--rays-per-pixel", 4)


@pytest.fixture(scope="module")
def trained(shared_tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with checkpoints at steps 20 and 40."""
    return train(shared_tiny, tmp_path_factory.mktemp("out"), "--max-num-iterations", 40, "--steps-per-save", 20)


@pytest.fixture
def finished(trained: Path, tmp_path: Path) -> Path:
    """A copy of that run, which a test may damage."""
    return Path(shutil.copytree(trained, tmp_path / "ball" / "instant-ngp" / "t"))


def no_constant(name: str) -> NoReturn:
    raise AssertionError(f"{name} is not JSON")


def evaluate(monkeypatch: pytest.MonkeyPatch, folder: Path, *flags: object) -> dict[str, Any]:
    """Run ns-eval; returns its file, read strictly."""
    words = ["ns-eval", "--load-config", folder / "config.yml", "--output-path", folder / "new" / "e.json", *flags]
    monkeypatch.setattr(sys, "argv", list(map(str, words)))
    main()
    return json.loads((folder / "new" / "e.json").read_text(), parse_constant=no_constant)


def edit_config(folder: Path, **values: object) -> None:
    config = yaml.safe_load((folder / "config.yml").read_text())
    (folder / "config.yml").write_text(yaml.safe_dump({**config, **values}))


@pytest.mark.medium
def test_the_file_has_nerfstudios_keys_and_its_means(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = evaluate(monkeypatch, finished)
    assert found["experiment_name"] == "ball"
    assert found["method_name"] == "instant-ngp"
    assert found["checkpoint"] == "step-000000040.ckpt"
    for name in ("psnr", "ssim"):
        values = [row[name] for row in found["per_image"]]
        assert found["results"][name] == pytest.approx(statistics.fmean(values))
        assert found["results"][f"{name}_std"] == pytest.approx(statistics.stdev(values))
    assert found["results"]["fps"] > 0
    assert found["results"]["num_rays_per_sec"] == pytest.approx(found["results"]["fps"] * 400 * 4)  # rays a pixel


def test_rays_per_pixel_are_as_the_run_says_or_as_asked(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usual, same, fewer = (evaluate(monkeypatch, finished, *flags) for flags in ((), RAYS, (RAYS[0], 1)))
    assert [found["rays_per_pixel"] for found in (usual, same, fewer)] == [4, 4, 1]
    assert usual["results"]["psnr"] == same["results"]["psnr"]
    assert usual["results"]["psnr"] != fewer["results"]["psnr"]


def test_an_image_that_is_not_finite_is_named_and_the_others_are_measured(
    finished: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    good, render, seen = evaluate(monkeypatch, finished), RayModel.render_view, list[View]()

    def broken_once(model: RayModel[Any], view: View, background: Tensor) -> Picture:
        picture = render(model, view, background)
        seen.append(view)
        return replace(picture, rgb=picture.rgb * torch.nan) if len(seen) == 2 else picture

    monkeypatch.setattr(RayModel, "render_view", broken_once)
    said = refused(main, "--load-config", finished / "config.yml", "--output-path", finished / "new" / "e.json")
    assert f"1 of {len(seen)} rendered images are not finite, first {good['per_image'][1]['name']}" in said
    found = json.loads((finished / "new" / "e.json").read_text(), parse_constant=no_constant)
    assert [row["psnr"] for row in found["per_image"]] == [
        None if rank == 1 else row["psnr"] for rank, row in enumerate(good["per_image"])
    ]
    assert (found["results"]["psnr"], found["results"]["num_images"]) == (None, len(seen))


def test_lpips_that_is_absent_is_null_with_a_reason(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfloom.base.extras.find_spec", lambda name: None)
    found = evaluate(monkeypatch, finished, "--max-images", 1)
    assert (found["results"]["lpips"], found["results"]["lpips_std"]) == (None, None)
    advice = "absent: pass a weights file with --lpips-weights (docs/guides/evaluation.md), or pip install lpips "
    assert found["lpips"].startswith(advice)


def test_rounded_numbers_are_those_of_the_written_pictures(
    finished: Path, shared_tiny: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """PSNR from the files alone: the PNG against the photograph over white."""
    pictures = finished / "renders"
    found = evaluate(monkeypatch, finished, "--render-output-path", pictures, "--round-to-uint8", "True")
    for index, row in enumerate(found["per_image"]):
        with Image.open(pictures / f"{index:04d}_r_{index}.png") as picture:
            render = np.asarray(picture, dtype=np.float64) / 255
        with Image.open(shared_tiny / "test" / f"r_{index}.png") as picture:
            rgba = np.asarray(picture, dtype=np.float64) / 255
        photograph = rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:])
        assert row["psnr"] == pytest.approx(-10 * np.log10(((render - photograph) ** 2).mean()), abs=1e-4)


@pytest.mark.medium
def test_the_chunk_size_changes_no_number(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = evaluate(monkeypatch, finished)
    edit_config(finished, eval_num_rays_per_chunk=37)
    chunked = evaluate(monkeypatch, finished)
    for name in ("psnr", "psnr_std", "ssim", "ssim_std"):
        assert chunked["results"][name] == pytest.approx(plain["results"][name], abs=1e-4)


def test_any_split_and_any_checkpoint(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(evaluate(monkeypatch, finished, "--split", "train")["per_image"]) == 10
    newest = evaluate(monkeypatch, finished, "--split", "val")
    assert len(newest["per_image"]) == 2
    older = finished / "nerfstudio_models" / "step-000000020.ckpt"
    found = evaluate(monkeypatch, finished, "--split", "val", "--load-checkpoint", older)
    assert found["checkpoint"] == older.name
    assert found["results"]["psnr"] != newest["results"]["psnr"]


def test_a_damaged_newest_checkpoint_falls_back(
    finished: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    newest = finished / "nerfstudio_models" / "step-000000040.ckpt"
    newest.write_bytes(newest.read_bytes()[:-500])
    found = evaluate(monkeypatch, finished, "--max-images", 1)
    assert found["checkpoint"] == "step-000000020.ckpt"
    assert f"{newest} is damaged" in capsys.readouterr().err


def test_what_is_missing_is_named(finished: Path, tmp_path: Path, refused: Refused) -> None:
    config = finished / "config.yml"
    (tmp_path / "file").write_text("in the way")
    cases: list[tuple[list[object], str]] = [
        (["--load-config", tmp_path / "no.yml"], f"cannot read {tmp_path / 'no.yml'}: No such file"),
        (["--load-config", config, "--max-images", 0], "--max-images is 0"),
        (
            ["--load-config", config, "--data", tmp_path / "gone"],
            f"--data {tmp_path / 'gone'}: there is no such folder",
        ),
        (["--load-config", config, "--load-checkpoint", tmp_path / "no.ckpt"], "there is no checkpoint"),
        (["--load-config", config, "--load-checkpoint", tmp_path / "file"], f"{tmp_path / 'file'} is damaged"),
        (["--load-config", config, "--output-path", tmp_path / "file" / "e.json"], str(tmp_path / "file")),
    ]
    for arguments, words in cases:
        assert words in refused(main, *arguments, status=2 if "--max-images" in arguments else 1)


def test_data_that_has_gone_is_named_by_its_folder(finished: Path, tmp_path: Path, refused: Refused) -> None:
    edit_config(finished, data=str(tmp_path / "elsewhere"))
    assert str(tmp_path / "elsewhere") in refused(main, "--load-config", finished / "config.yml")


def test_settings_that_do_not_fit_the_checkpoint(finished: Path, refused: Refused) -> None:
    edit_config(finished, hidden_width=32)
    said = refused(main, "--load-config", finished / "config.yml")
    assert "the checkpoint does not fit the model's settings" in said


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"features_per_level": 2**40}, "--features-per-level is 1099511627776; it must be from 1 to 64"),
        ({"machine": {"num_threads": 10**6}}, "--machine.num-threads is 1000000; it must be from 1 to 1024"),
    ],
)
def test_settings_beyond_any_machine_are_refused(
    settings: dict[str, Any], said: str, finished: Path, refused: Refused
) -> None:
    edit_config(finished, **settings)
    assert refused(main, "--load-config", finished / "config.yml", "--device-type", "cpu").startswith(f"error: {said}")


@pytest.mark.parametrize("zipped", [True, False])
def test_a_checkpoint_that_would_run_code_does_not(zipped: bool, finished: Path, tmp_path: Path) -> None:
    evil, proof = tmp_path / "evil.ckpt", tmp_path / "proof"
    content = {"format": 1, "model": Malicious(proof)}
    if zipped:
        torch.save(content, evil)
    else:
        evil.write_bytes(pickle.dumps(content))
    done = called("ns-eval", "--load-config", finished / "config.yml", "--load-checkpoint", evil)
    assert done.returncode == 1
    assert done.stderr.strip() == f"error: {evil} is damaged or not a checkpoint of nerfloom"
    assert not proof.exists()


def test_a_missing_flag_is_named() -> None:
    done = called("ns-eval")
    assert done.returncode == 2
    assert "--load-config" in done.stderr
    assert "Traceback" not in done.stderr

"""Facts read from the data, decisions from them, and a run that follows both."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from nerfloom.cli.session import start
from nerfloom.scene.profile import SceneProfile
from nerfloom.training import trainer as trainer_module
from nerfloom.training.checkpoint import FOLDER
from nerfloom.training.preparation import profile_of
from nerfloom.training.trainer import Trainer
from tests.training.helpers import assert_same_bits, tensors, tiny_run, tiny_trainer


def decisions(trainer: Trainer) -> dict[str, tuple[str, str]]:
    return {d.option: (d.choice, d.reason) for d in trainer.profile.decisions}


def test_facts_and_decisions_of_photographs_with_alpha(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=1, max_resolution="auto")
    profile, data = trainer.profile, trainer.train_set
    assert profile.images == len(data)
    assert (profile.width, profile.height) == (int(data.cameras.widths[0]), int(data.cameras.heights[0]))
    assert profile.transparent == pytest.approx((data.pixels[:, 3].numpy() == 0).mean(), abs=1e-6)
    found = decisions(trainer)
    assert found["background"] == ("random", "the photographs have alpha")
    assert found["silhouettes"][0].startswith("space outside them is skipped")
    finest = trainer.model.field.encoding.layout.resolutions[-1]  # type: ignore[union-attr]
    assert found["finest cells along an axis"][0] == str(finest)
    trainer.train()
    assert bool(trainer.model.sampler.carved.any())  # as announced


def test_times_that_a_still_method_ignores_are_announced(shared_tiny: Path, tmp_path: Path) -> None:
    run = tiny_run("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=1)
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "still", max_num_iterations=1)
    still = trainer.train_set
    moving = replace(still, times=torch.linspace(0, 1, len(still)), scene=replace(still.scene, moving=True))
    (tmp_path / "run").mkdir()
    found = decisions(Trainer.of(run, moving))
    assert found["times"][0] == "ignored"
    assert "instant-ngp" in found["times"][1]
    assert found["silhouettes"][0] == "not used"
    assert "too few to tell how fast" in found["silhouettes"][1]
    assert "times" not in decisions(trainer)


def test_without_alpha_the_background_is_black_and_no_silhouette_used(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=1)
    opaque = replace(
        trainer.train_set,
        pixels=trainer.train_set.pixels[:, :3].contiguous(),
        scene=replace(trainer.train_set.scene, has_alpha=False),
    )
    found = Trainer(trainer.method, trainer.config, opaque)
    assert decisions(found)["background"] == ("black", "no photograph has alpha")
    assert decisions(found)["silhouettes"] == ("not used", "no photograph has alpha")
    assert found.profile.transparent is None
    found.train_step()
    assert not bool(found.model.sampler.carved.any())  # as announced


def test_poses_that_seem_to_be_folded_are_warned_of(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=1)
    count, data = 40, trainer.train_set
    angles = torch.linspace(0, 350, count)
    rates, waves = (
        torch.deg2rad(angles)[:, None] * torch.arange(1, 5),
        torch.randn(2, 4, 400, generator=torch.Generator().manual_seed(0)),
    )
    seen = rates.cos() @ waves[0] + rates.sin() @ waves[1]
    pixels = (40 * seen / seen.std() + 128).clamp(0, 255).to(torch.uint8).reshape(-1, 1).repeat(1, 3)

    def warning(angles: torch.Tensor, **scene: object) -> tuple[str, str] | None:
        turn, zero = torch.deg2rad(angles), torch.zeros(count)
        columns = [turn.cos(), turn.sin(), zero], [zero, zero, zero + 1], [turn.sin(), -turn.cos(), zero]
        poses = torch.stack([torch.stack(column, -1) for column in (*columns, [zero, zero, zero])], -1)
        cameras = replace(data.cameras[torch.zeros(count, dtype=torch.int64)], camera_to_worlds=poses)
        photographs: dict[str, object] = {"has_alpha": False, "num_cameras": count, "poses": "photographs"} | scene
        walk = replace(
            data,
            pixels=pixels,
            cameras=cameras,
            paths=tuple(Path(f"{index}.jpg") for index in range(count)),
            scene=replace(data.scene, **photographs),  # type: ignore[arg-type]
        )
        return decisions(Trainer(trainer.method, trainer.config, walk)).get("warning, poses")

    folded = warning(angles % 180)
    assert folded is not None
    assert folded[1].startswith("20.jpg and 21.jpg look alike, but their cameras look 17")
    assert "(such pairs: 1)" in folded[1]
    assert warning(angles) is None
    assert warning(angles % 180, poses="exact") is None


def test_what_the_user_decided_is_not_called_a_decision(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer(
        "instant-ngp",
        shared_tiny,
        tmp_path / "run",
        max_num_iterations=1,
        background="white",
        background_model="none",
        silhouette_cells=False,
        sampler="occupancy",
    )
    assert decisions(trainer) == {}


def test_it_is_computed_once_printed_and_saved(
    shared_tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = list[SceneProfile]()

    def counted(*parts: Any) -> SceneProfile:
        found.append(profile_of(*parts))
        return found[-1]

    monkeypatch.setattr(trainer_module, "profile_of", counted)
    run = tiny_run("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=1, max_eval_images=0)
    start(run)
    assert len(found) == 1
    printed = capsys.readouterr()
    saved = json.loads((tmp_path / "run" / "scene_profile.json").read_text())
    text = " ".join((printed.out + printed.err).split())
    for decision in saved["decisions"]:
        assert f"{decision['option']}: {decision['choice']}" in text
    assert f"{saved['images']} images of {saved['width']} x {saved['height']}" in text


def test_a_run_that_begins_with_a_checkpoint_has_one_too(shared_tiny: Path, tmp_path: Path) -> None:
    settings = {"max_num_iterations": 1, "max_eval_images": 0}
    start(tiny_run("instant-ngp", shared_tiny, tmp_path / "first", **settings))
    start(tiny_run("instant-ngp", shared_tiny, tmp_path / "second", load_dir=tmp_path / "first" / FOLDER, **settings))
    first, second = (json.loads((tmp_path / name / "scene_profile.json").read_text()) for name in ("first", "second"))
    assert second == first


def test_robust_training_is_resumed_with_the_same_bits(shared_tiny: Path, tmp_path: Path) -> None:
    settings = {"max_num_iterations": 12, "robust": "errors"}
    whole = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "whole", **settings)
    whole.train()
    first = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "first", **settings)
    for _ in range(5):
        first.train_step()
    first.save()
    second = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "second", load_dir=first.checkpoint_folder, **settings)
    second.restore_as_configured()
    second.train()
    learnt, resumed = whole.source.state(), second.source.state()
    assert learnt is not None
    assert resumed is not None
    assert torch.equal(learnt, resumed)
    assert len(learnt.unique()) > 2
    assert_same_bits(tensors(whole), tensors(second))

"""The trainer: it learns, it repeats itself bit for bit, it resumes, it stops, and it does not hide NaN."""

import dataclasses
import json
import math
import os
import signal
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from nerfloom import Loss, Model, PixelBatch, RayModel, Rays, Rendered, registry
from nerfloom.base.errors import CheckpointError, ConfigError, DivergenceError
from nerfloom.base.signals import stop_signals
from nerfloom.dataparsers.blender import Blender
from nerfloom.evaluation.evaluator import evaluate
from nerfloom.methods import instant_ngp
from nerfloom.methods.instant_ngp import InstantNGPConfig
from nerfloom.registry import load_method
from nerfloom.training import trainer as trainer_file
from nerfloom.training.checkpoint import list_checkpoints, load_checkpoint
from nerfloom.training.datasets import first_split, load_split
from nerfloom.training.outcome import Outcome
from nerfloom.training.report import write_summary
from nerfloom.training.run import create_folder
from nerfloom.training.trainer import Trainer
from tests.conftest import TICK
from tests.training.helpers import TINY, assert_same_bits, tensors, tiny_run, tiny_trainer

KINDS = list(TINY)
RAY_KINDS = [kind for kind in TINY if kind not in ("gaussian-splatting", "moving-gaussians")]
"""Methods that render rays, in chunks."""


QUICK = ("instant-ngp", "vanilla-nerf", "nerfacto", "gaussian-splatting")
"""Methods that learn, and render in chunks, in the fast set; test_check_method.py tests both for all, faster."""


def quick(kinds: list[str]) -> list[Any]:
    """The kinds that are not slow."""
    return [pytest.param(kind, marks=() if kind in QUICK else pytest.mark.slow) for kind in kinds]


@pytest.mark.medium
@pytest.mark.parametrize("kind", quick(KINDS))
def test_it_learns(kind: str, shared_tiny: Path, tmp_path: Path) -> None:
    steps = 120 if kind in QUICK else 250
    trainer = tiny_trainer(kind, shared_tiny, tmp_path / "run", evaluated=True, max_num_iterations=steps)
    assert trainer.eval_set is not None
    before = evaluate(trainer.model, trainer.eval_set).results["psnr"]
    outcome = trainer.train()
    after = evaluate(trainer.model, trainer.eval_set).results["psnr"]
    print(f"{kind}: {before:.1f} -> {after:.1f} dB, {outcome.reason}")
    assert after > before + 6
    assert outcome.reason == f"{steps} steps done"
    assert trainer.state.skipped == 0


FEW_RAYS = {"num_rays_per_batch": 48, "samples_per_batch": 1024}
"""Smaller batches than in tiny runs: a comparison of bits needs little training."""


def once_a_method(kinds: list[str]) -> list[Any]:
    """All kinds. Those of a method whose first kind is asked already are slow: their parts are others' too."""
    return [pytest.param(kind, marks=pytest.mark.slow if "+" in kind else ()) for kind in kinds]


@pytest.mark.medium
@pytest.mark.parametrize("kind", once_a_method(KINDS))
def test_resuming_continues_with_the_same_bits(kind: str, shared_tiny: Path, tmp_path: Path) -> None:
    """Interrupted after 13 steps, evaluated in between, resumed in a new trainer: as if nothing had happened."""
    settings: dict[str, Any] = {name: value for name, value in FEW_RAYS.items() if name in TINY[kind]}
    settings["max_num_iterations"] = 22
    whole = tiny_trainer(kind, shared_tiny, tmp_path / "whole", **settings)
    whole.train()

    first = tiny_trainer(kind, shared_tiny, tmp_path / "parts", evaluated=True, **settings)
    for _ in range(13):
        first.train_step()
    assert first.eval_set is not None
    evaluate(first.model, first.eval_set)
    checkpoint = first.save()
    torch.rand(7)  # other draws in between have no effect
    second = tiny_trainer(kind, shared_tiny, tmp_path / "second", **settings)
    second.restore(load_checkpoint(checkpoint))
    assert second.state.step == 13
    second.train()
    assert_same_bits(tensors(whole), tensors(second))
    assert second.state.rays == whole.state.rays


def test_another_seed_gives_other_bits(shared_tiny: Path, tmp_path: Path) -> None:
    from nerfloom.base.machine_config import MachineConfig

    runs = [
        tiny_trainer("instant-ngp", shared_tiny, tmp_path / str(seed), machine=MachineConfig(seed=seed))
        for seed in (1, 2)
    ]
    assert not torch.equal(runs[0].model.field.encoding.table, runs[1].model.field.encoding.table)


@pytest.mark.usefixtures("even_clock")
def test_budgets(shared_tiny: Path, tmp_path: Path) -> None:
    by_time = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "a", max_seconds=0.3)
    assert by_time.train().reason == "0.3 s of training spent"
    assert 0.3 <= by_time.state.seconds < 0.3 + 2 * TICK
    assert by_time.progress == 1.0
    by_psnr = tiny_trainer(
        "instant-ngp", shared_tiny, tmp_path / "b", evaluated=True, target_psnr=12.0, steps_per_eval_all_images=20
    )
    assert by_psnr.train().reason == "12 dB reached"
    curve = json.loads((tmp_path / "b" / "learning_curve.json").read_text())
    assert curve[-1]["psnr"] >= 12.0
    assert curve[-1]["step"] == by_psnr.state.step
    assert curve[-1]["seconds"] == pytest.approx(by_psnr.state.seconds)


def test_checkpoints_hold_plain_data_and_fit_their_model_only(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=6, steps_per_save=2)
    last = trainer.train().checkpoint
    assert [p.name for p in list_checkpoints(last.parent)] == ["step-000000004.ckpt", "step-000000006.ckpt"]
    content = torch.load(last, weights_only=True)
    assert content["method"] == "instant-ngp"
    assert content["state"]["step"] == 6
    other = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "other", hidden_width=32)
    with pytest.raises(CheckpointError, match="does not fit the model's settings"):
        other.restore(content)


def test_load_dir_and_load_checkpoint(shared_tiny: Path, tmp_path: Path) -> None:
    last = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=6).train().checkpoint
    for setting in ({"load_dir": last.parent}, {"load_checkpoint": last}):
        trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / str(len(list(tmp_path.iterdir()))), **setting)
        trainer.restore_as_configured()
        assert trainer.state.step == 6
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "none", load_dir=tmp_path / "nowhere")
    with pytest.raises(CheckpointError, match=r"--load-dir .*nowhere: there is no checkpoint"):
        trainer.restore_as_configured()


def test_a_full_disk_does_not_end_a_run(
    shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=8, steps_per_save=2)
    trainer.train_step()
    trainer.save()
    true_save, failures = torch.save, []

    def sometimes_full(content: Any, file: Any) -> None:
        if trainer.state.step < 8:
            failures.append(trainer.state.step)
            raise OSError(28, "No space left on device")
        true_save(content, file)

    monkeypatch.setattr(torch, "save", sometimes_full)
    trainer.train()
    assert failures == [2, 4, 6]
    assert capsys.readouterr().err.count("No space left on device") == 3
    kept = [p.name for p in list_checkpoints(trainer.checkpoint_folder)]
    assert kept == ["step-000000001.ckpt", "step-000000008.ckpt"]


def test_a_split_that_cannot_be_read_is_reported(tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tiny / "transforms_val.json").write_text("{")
    run = tiny_run("instant-ngp", tiny, tiny)
    found = first_split(run, ("val", "test"))
    assert found is not None
    assert len(found) == 3
    (tiny / "transforms_test.json").unlink()
    assert first_split(run, ("val", "test")) is None
    said = capsys.readouterr().err
    assert said.count("no 'val' images to evaluate on") == 2
    assert said.count("no 'test' images to evaluate on: cannot read") == 1


def test_a_folder_with_a_run_is_not_taken_twice(shared_tiny: Path, tmp_path: Path) -> None:
    run = tiny_run("instant-ngp", shared_tiny, tmp_path / "run")
    create_folder(run)
    with pytest.raises(ConfigError, match="ns-train --resume /"):
        create_folder(run)


def test_a_folder_that_cannot_be_written(shared_tiny: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(ConfigError, match="cannot write the run's folder"):
        create_folder(tiny_run("instant-ngp", shared_tiny, tmp_path / "file" / "run"))


@dataclass(frozen=True)
class SickConfig(InstantNGPConfig):
    """instant-ngp that breaks at the given steps."""

    bad_steps: tuple[int, ...] = ()
    where: str = "loss"


class Sick(RayModel[SickConfig]):
    """Its loss or its gradients are NaN at the chosen steps."""

    def loss(self, batch: PixelBatch, step: int) -> Loss:
        loss = super().loss(batch, step)
        if step in self.config.bad_steps:
            if self.config.where == "loss":
                loss.terms["rgb"] = loss.terms["rgb"] * math.nan
            else:  # finite loss, NaN gradient: sqrt at 0
                loss.terms["sick"] = (self.field.density_head[0].weight * 0).sum().sqrt()
        return loss


METHOD = dataclasses.replace(instant_ngp.METHOD, config=SickConfig(), model=Sick, paper="none")


@pytest.fixture
def sick(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = registry.Entry("sick", "tests.training.test_trainer", "METHOD", "the tests")
    known = {**registry.registered("methods"), "sick": entry}
    monkeypatch.setattr(registry, "registered", lambda kind: known)


@pytest.mark.usefixtures("sick")
@pytest.mark.parametrize("where", ["loss", "gradient"])
def test_non_finite_steps_are_dropped_and_counted(where: str, shared_tiny: Path, tmp_path: Path) -> None:
    settings = {**TINY["instant-ngp"], "bad_steps": (3, 5, 6), "where": where, "max_num_iterations": 12}
    trainer = tiny_trainer("sick", shared_tiny, tmp_path / "run", **settings)
    for _ in range(3):
        trainer.train_step()
    before = tensors(trainer)
    trainer.train_step()
    assert_same_bits(before, tensors(trainer))
    trainer.train()
    assert trainer.state.skipped == 3
    assert all(bool(torch.isfinite(p).all()) for p in trainer.model.parameters())


@pytest.mark.usefixtures("sick")
def test_ten_in_a_row_stop_the_run_and_the_checkpoint_stands(shared_tiny: Path, tmp_path: Path) -> None:
    settings = {**TINY["instant-ngp"], "bad_steps": tuple(range(4, 99)), "where": "gradient", "steps_per_save": 4}
    trainer = tiny_trainer("sick", shared_tiny, tmp_path / "run", **settings)
    with pytest.raises(DivergenceError, match=r"10 steps in a row .* field\.density_head\.0\.weight\.grad"):
        trainer.train()
    saved = load_checkpoint(list_checkpoints(trainer.checkpoint_folder)[0])
    assert all(bool(torch.isfinite(v).all()) for k, v in saved["model"].items() if "grid" not in k)


def test_an_empty_grid_is_harmless(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run")
    sampler = trainer.model.sampler
    sampler.occupied.zero_()
    sampler.forget()
    report = trainer.train_step()
    assert trainer.state.skipped == 0
    assert math.isfinite(sum(report.losses.values()))
    cameras = trainer.train_set.cameras
    rays = cameras.pixel_rays(cameras.image_pixels(0), 0.0, 10.0)
    background = torch.tensor([0.1, 0.2, 0.3])
    for part in (rays, rays[:0]):
        out = trainer.model.render(part, background)
        torch.testing.assert_close(out.rgb, background.expand(len(part), 3))


def in_chunks_of(trainer: Trainer, rays: int) -> None:
    """Let its model render a number of rays at once."""
    trainer.model.config = dataclasses.replace(trainer.model.config, eval_num_rays_per_chunk=rays)


@pytest.mark.parametrize("kind", quick(RAY_KINDS))
def test_a_picture_does_not_depend_on_the_chunks(kind: str, shared_tiny: Path, tmp_path: Path) -> None:
    pictures = []
    trainer = tiny_trainer(kind, shared_tiny, tmp_path / "run", evaluated=True)
    for _ in range(5):
        trainer.train_step()
    assert trainer.eval_set is not None
    for chunk in (57, 8192):
        in_chunks_of(trainer, chunk)
        view = trainer.model.render_view(trainer.eval_set.view(0), trainer.model.background)
        pictures.append((view.rgb, view.median_depth))
    torch.testing.assert_close(pictures[0][0], pictures[1][0], atol=2e-3, rtol=0)  # bfloat16 products differ by size
    assert isinstance(trainer.model, Model)


def test_evaluation_cameras_are_not_taken_for_training_ones(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", evaluated=True)
    seen: list[Rays] = []
    true_render = trainer.model.render

    def spy(rays: Rays, background: Tensor) -> Rendered:
        seen.append(rays)
        return true_render(rays, background)

    trainer.model.render, trainer.model.plain = spy, False
    assert trainer.eval_set is not None
    evaluate(trainer.model, trainer.eval_set)
    assert seen
    assert all(rays.camera_indices is None for rays in seen)


@pytest.mark.medium
def test_looking_on_changes_no_bit(shared_tiny: Path, tmp_path: Path) -> None:
    """Pictures for TensorBoard and evaluations between steps leave the trained bits alone."""
    blind = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "blind", max_num_iterations=20)
    looking = {"steps_per_eval_image": 3, "steps_per_eval_all_images": 7, "vis": "tensorboard"}
    seeing = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "seeing", True, max_num_iterations=20, **looking)
    blind.train()
    seeing.train()
    assert_same_bits(tensors(blind), tensors(seeing))
    curve = json.loads((tmp_path / "seeing" / "learning_curve.json").read_text())
    assert [row["step"] for row in curve if row["full"]] == [7, 14]
    assert list((tmp_path / "seeing").glob("events.out.tfevents.*"))


@pytest.mark.medium
@pytest.mark.parametrize("kind", quick(RAY_KINDS))
def test_metrics_do_not_depend_on_the_chunks(kind: str, shared_tiny: Path, tmp_path: Path) -> None:
    found = []
    trainer = tiny_trainer(kind, shared_tiny, tmp_path / "run", evaluated=True, mixed_precision=False)
    for _ in range(10):
        trainer.train_step()
    assert trainer.eval_set is not None
    for chunk in (57, 400, 8192):
        in_chunks_of(trainer, chunk)
        found.append(evaluate(trainer.model, trainer.eval_set).results)
    for other in found[1:]:
        for name in ("psnr", "ssim"):
            assert other[name] == pytest.approx(found[0][name], abs=1e-4)


def test_a_small_picture_has_no_ssim_and_no_lpips_and_says_so(tiny: Path, tmp_path: Path) -> None:
    run = dataclasses.replace(tiny_run("instant-ngp", tiny, tmp_path / "run"), parser=Blender(downscale_factor=2))
    create_folder(run)
    trainer = Trainer.of(run, load_split(run, "train"), load_split(run, "val"))
    assert trainer.eval_set is not None
    found = evaluate(trainer.model, trainer.eval_set)
    assert found.results["ssim"] is None
    assert math.isfinite(found.results["psnr"])
    assert "SSIM absent" in found.line()


@pytest.mark.usefixtures("ctrl_c_raises")
def test_a_second_ctrl_c_ends_at_once() -> None:
    with pytest.raises(KeyboardInterrupt), stop_signals() as received:  # noqa: PT012
        os.kill(os.getpid(), signal.SIGINT)
        assert received == [signal.SIGINT]
        os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_good_checkpoint_outlives_a_divergence(shared_tiny: Path, tmp_path: Path) -> None:
    """Ten bad steps that would all be saved: the state from before must still be there."""
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", steps_per_save=2)
    for _ in range(3):
        trainer.train_step()
    trainer.save()
    for group in trainer.optimizer.param_groups:
        group["initial_lr"] = 1e38  # the next step is finite, and ruins every parameter
    with pytest.raises(DivergenceError, match="the last good checkpoint is in"):
        trainer.train()
    losses = []
    for path in list_checkpoints(trainer.checkpoint_folder):
        again = tiny_trainer("instant-ngp", shared_tiny, tmp_path / path.stem)
        again.restore(load_checkpoint(path))
        losses.append(sum(again.train_step().losses.values()))
    assert any(math.isfinite(loss) for loss in losses), losses


@pytest.mark.medium
def test_what_was_evaluated_is_not_forgotten_by_a_run_that_goes_on(shared_tiny: Path, tmp_path: Path) -> None:
    """A step that is evaluated and saved: whoever goes on from there does not come back to it."""
    settings = {"steps_per_eval_all_images": 4, "steps_per_save": 4, "max_num_iterations": 12}
    whole = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "whole", True, **settings)
    whole.train()
    assert [step for _, step, *_ in whole.state.curve] == [4, 8, 12]
    for checkpoint in list_checkpoints(whole.checkpoint_folder):
        again = tiny_trainer("instant-ngp", shared_tiny, tmp_path / checkpoint.stem, True, **settings)
        again.restore(load_checkpoint(checkpoint))
        again.train()
        assert [entry[1:6] for entry in again.state.curve] == [entry[1:6] for entry in whole.state.curve]
        written = json.loads((again.folder / "learning_curve.json").read_text())
        written = [row for row in written if row["full"]]  # when a few images are looked at follows the clock
        assert [row["step"] for row in written] == [4, 8, 12]
        assert [row["seconds"] for row in written] == sorted(row["seconds"] for row in written)


def test_the_next_evaluation_is_due_when_it_would_have_been(shared_tiny: Path, tmp_path: Path) -> None:
    settings = {"seconds_per_eval_all_images": 1e9, "max_num_iterations": 3}
    first = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "first", True, **settings)
    first.train_step()
    first.state.seconds, first.state.curve = 1.5e9, ((0.2e9, 1, 10.0),)
    second = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "second", True, **settings)
    second.restore(load_checkpoint(first.save()))
    second.train()
    assert [step for _, step, *_ in second.state.curve] == [1, 2]


def test_what_a_killed_save_left_behind_is_cleared_by_the_next(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=4, steps_per_save=2)
    trainer.checkpoint_folder.mkdir(parents=True)
    (trainer.checkpoint_folder / ".step-000000001.ckpt.99999999.tmp").write_bytes(b"half of one")
    trainer.train()
    names = sorted(path.name for path in trainer.checkpoint_folder.iterdir())
    assert names == ["step-000000002.ckpt", "step-000000004.ckpt"]


@pytest.mark.parametrize("key", ["model", "optimizer", "state"])
def test_a_checkpoint_with_a_part_of_another_kind_is_refused(key: str, shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run")
    content = {**load_checkpoint(trainer.save()), key: [1]}
    with pytest.raises(CheckpointError):
        trainer.restore(content)


def test_a_checkpoint_of_another_method_is_refused(shared_tiny: Path, tmp_path: Path) -> None:
    saved = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "a").save()
    other = tiny_trainer("vanilla-nerf", shared_tiny, tmp_path / "b")
    with pytest.raises(CheckpointError, match="does not fit"):
        other.restore(load_checkpoint(saved))


def test_rays_per_second_are_those_since_errors_were_read(
    shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a device that runs ahead, only a step that reads from it takes the time of the steps before it."""
    trainer = tiny_trainer("vanilla-nerf", shared_tiny, tmp_path, num_rays_per_batch=30)
    trainer.steps_per_read = 4
    trainer.prepare()
    moments = iter([0.0, 3.0, 3.0, 3.1, 3.1, 3.2, 3.2, 6.0, 6.0, 6.1, 6.1, 6.2, 6.2, 6.3, 6.3, 9.0])
    monkeypatch.setattr(trainer_file, "time", SimpleNamespace(perf_counter=lambda: next(moments)))
    rates = [trainer.train_step().rays_per_second for _ in range(8)]
    first, then, last = 30 / 3.0, 4 * 30 / 6.0, 4 * 30 / 3.0
    assert rates == pytest.approx([first, first, first, then, then, then, then, last])


@pytest.mark.parametrize(("method", "casts_rays"), [("voxels", True), ("gaussian-splatting", False)])
def test_the_summary_has_the_samples_of_a_ray_where_rays_are_cast(
    method: str, casts_rays: bool, shared_tiny: Path, tmp_path: Path
) -> None:
    trainer = tiny_trainer(method, shared_tiny, tmp_path / "run", max_num_iterations=1)
    trainer.state.samples_per_ray = 12.5
    write_summary(tmp_path / "summary.json", trainer, Outcome("1 step done", None, None))
    found = json.loads((tmp_path / "summary.json").read_text())
    assert found.get("samples_per_ray", "none") == (12.5 if casts_rays else "none")


# -- without a run ------------------------------------------------------------------------------------------------


def test_a_trainer_without_a_folder_learns_the_same_and_writes_nothing(
    shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tiny_run("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=20, steps_per_save=5)
    create_folder(run)
    written = Trainer.of(run, load_split(run, "train"))
    written.train()
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    config = dataclasses.replace(run.config, vis="tensorboard")
    alone = Trainer(load_method("instant-ngp"), config, load_split(run, "train"), load_split(run, "val"))
    assert alone.train().checkpoint is None
    assert alone.save() is None
    nested = Trainer(load_method("instant-ngp"), config, load_split(run, "train"))
    assert [report.step for report in nested.steps()] == list(range(1, 21))
    assert list(nested.steps()) == []
    for trainer in (alone, nested):
        assert_same_bits(tensors(trainer), tensors(written))
    assert list((tmp_path / "empty").rglob("*")) == []


def test_what_others_have_set_is_not_started_anew(shared_tiny: Path, tmp_path: Path) -> None:
    """The Gaussians of a web page, for example, are set where a field has its surfaces."""
    run = tiny_run("gaussian-splatting", shared_tiny, tmp_path, max_num_iterations=1, start="random")
    trainer = Trainer(load_method(run.method), run.config, load_split(run, "train"))
    trainer.prepare(start=False)
    before = trainer.model.state_dict()["means.values"].clone()
    trainer.prepare()
    assert torch.equal(trainer.model.state_dict()["means.values"], before)

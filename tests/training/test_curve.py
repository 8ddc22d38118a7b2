"""The learning curve: every run has one, it has the stated cost, and it does not change training."""

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from nerfloom.base.checked import checked
from nerfloom.cameras.view import every
from nerfloom.evaluation.evaluator import Measured, evaluate
from nerfloom.evaluation.metrics import psnr
from nerfloom.registry import load_method, registered
from nerfloom.training.checkpoint import load_checkpoint
from nerfloom.training.curve import (
    MAX_IMAGES,
    MAX_TIME_SHARE,
    PLANNED_SHARE,
    FewImages,
    Point,
    in_order,
    is_due,
    num_rays,
    pixel_stride,
    rows,
)
from nerfloom.training.progress import StepReport
from nerfloom.training.state import State
from nerfloom.training.trainer import Trainer
from tests.training.helpers import assert_same_bits, tensors, tiny_trainer


def written(trainer: Trainer) -> list[dict[str, Any]]:
    return json.loads((trainer.folder / "learning_curve.json").read_text())


@pytest.mark.parametrize("seconds", [4.0, 3600.0])
@pytest.mark.parametrize("size", [24, 1500])
@pytest.mark.parametrize(
    ("learnt", "shown", "rays_per_pixel"),  # rays a second in training and in pictures, as measured on two cores
    [(240e3, 1100e3, 4), (38e3, 88e3, 1), (12e3, 80e3, 1)],
    ids=["instant-ngp", "nerfacto", "vanilla-nerf"],
)
def test_every_run_has_a_curve_at_its_price(
    learnt: float, shown: float, rays_per_pixel: int, size: int, seconds: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fake clock gives short steps after a first one of a second, and pictures at a given speed."""
    clock = [0.0]
    monkeypatch.setattr("nerfloom.training.curve.time.perf_counter", lambda: clock[0])
    few = FewImages.__new__(FewImages)
    few._views, few._sizes, few._rays_per_pixel = [0, 1, 2], [(size, size)] * 3, rays_per_pixel

    def measure(model: object, stride: int) -> Measured:
        clock[0] += num_rays(few._sizes, stride, rays_per_pixel) / shown
        return Measured(20.0, 0.5)

    monkeypatch.setattr(few, "_measure", measure)
    points, now, step, model = list[Point](), 1.0, 1, SimpleNamespace(device=torch.device("cpu"))
    while now < seconds:
        now, step = now + max(0.03, seconds / 1000), step + 1
        report = StepReport(step, now, min(now / seconds, 1.0), {}, 20.0, learnt, None)
        found = few.look_if_due(model, [point.entry() for point in points], report, last=now >= seconds)  # type: ignore[arg-type]
        points += [] if found is None else [found]
    spent = sum(point.evaluation_seconds or 0.0 for point in points)
    print(f"{len(points)} points, stride {points[-1].pixel_stride}, {spent / now:.1%} of {seconds:g} s")
    assert len(points) >= 4
    assert spent <= MAX_TIME_SHARE * now
    assert len(points) <= 60
    assert len({point.pixel_stride for point in points[1:]}) == 1
    assert points[-1].seconds > 0.8 * seconds


@pytest.mark.medium
def test_looks_change_no_bit(shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfloom.training.curve.MAX_TIME_SHARE", math.inf)
    monkeypatch.setattr("nerfloom.training.curve.MIN_SPACING", 0.0)
    blind = tiny_trainer("nerfacto", shared_tiny, tmp_path / "blind", max_num_iterations=8)
    seeing = tiny_trainer("nerfacto", shared_tiny, tmp_path / "seeing", True, max_num_iterations=8)
    blind.train()
    seeing.train()
    assert [point["step"] for point in written(seeing)] == list(range(1, 9))
    assert written(blind) == []
    assert_same_bits(tensors(blind), tensors(seeing))


def test_a_look_is_what_its_pixels_say(shared_tiny: Path, tmp_path: Path) -> None:
    """Without a stride it is the evaluation of the same images; with a stride, of every n-th pixel of them."""
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", evaluated=True)
    for _ in range(10):
        trainer.train_step()
    model, dataset = trainer.model, trainer.eval_set
    assert dataset is not None
    report = StepReport(10, 1e9, 1.0, {}, 20.0, 1e9, None)
    found = FewImages(dataset, None, 1).look_if_due(model, (), report, last=False)
    whole = evaluate(model, dataset)
    assert found is not None
    assert (found.psnr, found.ssim) == (whole.results["psnr"], whole.results["ssim"])
    assert (found.images, found.pixel_stride, found.full) == (2, 1, False)
    background = model.background
    full = model.render_view(dataset.view(0), background)
    part = model.render_view(dataset.view(0, stride=3), background)
    for name in ("rgb", "depth", "accumulation"):  # bfloat16 products differ by the number of rays
        torch.testing.assert_close(getattr(part, name), every(getattr(full, name), 3), atol=2e-2, rtol=0)
    assert part.rgb.shape == (7, 7, 3)


def test_what_the_first_look_compiles_on_a_gpu_is_not_the_cost_of_the_next(
    shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", evaluated=True)
    dataset, costs, clock = trainer.eval_set, [1.0, 10.0], [0.0]
    assert dataset is not None

    def measure(self: FewImages, model: Any, stride: int) -> Measured:
        clock[0] += costs.pop()
        return Measured(20.0, None)

    monkeypatch.setattr("nerfloom.training.curve.time", SimpleNamespace(perf_counter=lambda: clock[0]))

    monkeypatch.setattr(FewImages, "_measure", measure)
    monkeypatch.setattr("nerfloom.training.curve.runs_ahead", lambda device: True)
    found = FewImages(dataset, None, 1).look_if_due(
        trainer.model, (), StepReport(10, 1e9, 1.0, {}, 20.0, 1e9, None), last=False
    )
    assert found is not None
    assert found.evaluation_seconds == 1.0
    assert not costs


def test_every_so_many_th_pixel_estimates_psnr_without_bias() -> None:
    torch.manual_seed(0)
    target = torch.rand(200, 200, 3)
    wrong = (target + 0.1 * torch.randn_like(target)).clamp(0, 1)
    assert psnr(every(wrong, 7), every(target, 7)) == pytest.approx(psnr(wrong, target), abs=0.2)
    assert every(target, 7).shape == (29, 29, 3)
    assert torch.equal(every(target, 1), target)


def test_the_stride_leaves_as_many_pixels_as_there_is_time_for() -> None:
    sizes = [(400, 400)] * 3
    assert pixel_stride(sizes, 1, 1e9) == 4  # 2^14 pixels are enough
    assert pixel_stride([(24, 24)], 16, 1.0) == 1  # and 16 along a side the least
    assert pixel_stride(sizes, 4, 0.0) == 25
    for rays in (3_000.0, 10_000.0, 50_000.0, 150_000.0):
        stride = pixel_stride(sizes, 4, rays)
        assert num_rays(sizes, stride, 4) <= 1.3 * rays  # a last row or column that is begun counts whole
        assert stride == 4 or num_rays(sizes, stride - 1, 4) > rays


def test_a_look_comes_when_it_is_time_and_when_there_is_time() -> None:
    before = [Point(10.0, 5, 20.0, evaluation_seconds=0.2)]
    assert not is_due([], 1.0, 0.05)
    assert is_due([], 1.0, 0.03)
    assert not is_due(before, 11.0, 0.1)
    assert is_due(before, 11.6, 0.1)
    assert is_due(before, 11.0, 0.1, last=True)
    assert not is_due(before, 11.6, 0.3)
    assert not is_due(before, 11.6, 0.3, last=True)
    seconds, points = 0.0, list[Point]()
    while seconds < 3600:
        seconds += 1.0
        if is_due(points, seconds, 1.0):
            points.append(Point(seconds, 0, 20.0, evaluation_seconds=1.0))
    assert len(points) >= 25
    assert len(points) <= PLANNED_SHARE * MAX_TIME_SHARE * seconds
    assert seconds / points[-1].seconds < 1.2


def test_it_goes_on_after_a_resume_and_with_points_of_early_versions(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "first", evaluated=True, max_num_iterations=3)
    trainer.state.curve = ((0.5, 1, 11.0),)
    trainer.state.looks = (Point(0.5, 1, 10.0, 0.4, 2, 3, 0.01, False).entry(),)
    trainer.state.seconds, trainer.state.step = 100.0, 2
    checkpoint = load_checkpoint(trainer.save())
    again = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "again", evaluated=True, max_num_iterations=3)
    again.restore(checkpoint)
    again.train()
    look, early, new = written(again)
    assert (early["psnr"], early["ssim"], early["images"], early["full"]) == (11.0, None, None, True)
    assert (look["psnr"], look["pixel_stride"], look["full"]) == (10.0, 3, False)
    assert (new["step"], new["full"]) == (3, False)
    old = {name: value for name, value in checkpoint["state"].items() if name != "looks"}
    assert checked(State, old).looks == ()


def test_what_json_cannot_hold_is_null() -> None:
    (row,) = rows(in_order([Point(1.0, 2, math.nan, ssim=math.inf, images=3).entry()]))
    assert (row["seconds"], row["psnr"], row["ssim"], row["images"]) == (1.0, None, None, 3)
    assert [point.step for point in in_order([(9.0, 8, 1.0)], [(1.0, 2, 1.0), (2.0, 9, 1.0)])] == [2, 8, 9]


@pytest.mark.parametrize("settings", [{"max_eval_images": 0}, {}])
def test_without_held_out_images_there_is_none(settings: dict[str, Any], shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer(
        "instant-ngp", shared_tiny, tmp_path / "run", bool(settings), max_num_iterations=3, **settings
    )
    trainer.train()
    assert written(trainer) == []


def test_no_more_images_than_asked_for(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", True, max_num_iterations=1)
    assert trainer.eval_set is not None
    report = StepReport(1, 1e9, 1.0, {}, 20.0, 1e9, None)
    ten = replace(trainer.train_set, drawn=None)
    for limit, expected in ((None, MAX_IMAGES), (1, 1), (9, MAX_IMAGES)):
        found = FewImages(ten, limit, 1).look_if_due(trainer.model, (), report, last=False)
        assert found is not None
        assert found.images == expected


def test_evaluations_over_all_images_come_within_every_methods_budget() -> None:
    for method in registered("methods"):
        config = load_method(method).config
        assert config.steps_per_eval_all_images <= config.max_num_iterations / 2, method


def test_a_target_is_met_by_all_images_alone(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", True, target_psnr=5.0, max_num_iterations=3)
    trainer.state.looks = (Point(0.5, 1, 50.0, None, 2, 1, 0.0, False).entry(),)
    assert trainer.train().reason == "3 steps done"

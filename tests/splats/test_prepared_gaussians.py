"""Gaussians that are drawn again and again: the same pictures, and new ones after a change."""

import dataclasses
from pathlib import Path

import pytest
import torch

from nerfloom import View
from nerfloom.benchmarks.frames import measure
from nerfloom.splats.drawing import draw_colors, draw_view, splat_camera
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import ELSEWHERE, OURS
from nerfloom.splats.prepared_gaussians import PreparedGaussians
from nerfloom.splats.rasteriser import RASTERISER, packed
from tests.kernels.compiled import needs_kernels
from tests.kernels.splat_truth import scene
from tests.splats.test_method import ball, camera
from tests.training.helpers import tiny_trainer


def cloud(count: int = 700) -> Gaussians:
    torch.manual_seed(0)
    means, log_scales, rotations, logits, colors, harmonics, _ = scene(count)
    return Gaussians(means - torch.tensor([0.0, 0, 4]), log_scales, rotations, logits, colors, harmonics)


def test_every_picture_is_the_first() -> None:
    """Gaussians at equal distances come in another order; here there are none."""
    seen, background = splat_camera(camera(), near=0.1), torch.rand(3)
    truth = draw_colors(cloud(), seen, 1, background)
    redrawn = PreparedGaussians(cloud(), RASTERISER)
    for _ in range(3):
        torch.testing.assert_close(redrawn.draw(seen, 1, background)[0], truth, atol=1e-6, rtol=0)
    torch.testing.assert_close(redrawn.draw(seen, 4, background)[0], truth[2::4, 2::4], atol=1e-6, rtol=0)


def test_pictures_by_depth() -> None:
    """One Gaussian is nearer along the axis, the other to the camera; packed or not, the former is in front."""
    pair = dataclasses.replace(
        ball(),
        means=torch.tensor([[0.0, 0.0, 0.05], [0.9, 0.0, 0.1]]),
        log_scales=torch.tensor([[0.5, 0.5, 1e-3], [1.0, 1.0, 1e-3]]).log(),
        **{name: getattr(ball(), name).expand(2, -1) for name in ("rotations",)},
        logits=torch.full((2,), 8.0), colors=torch.tensor([[1.7, -1.7, -1.7], [-1.7, 1.7, -1.7]]),
        harmonics=torch.zeros(2, 3, 0),
    )  # fmt: skip
    assert float((pair.means - torch.tensor([0.0, 0, 3.0])).norm(dim=-1).diff()) > 0  # the first is nearer
    for look, color in ((OURS, 0), (ELSEWHERE, 1)):
        seen = splat_camera(camera(), 0.1, look)
        redrawn, background = PreparedGaussians(pair, RASTERISER), torch.zeros(3)
        pictures = [redrawn.draw(seen, 1, background)[0] for _ in range(3)]
        pictures.append(draw_view(pair, seen, 1, background, 9.0).rgb)
        for picture in pictures:
            assert int(picture[16, 20].argmax()) == color, look


@needs_kernels
def test_what_no_picture_shows_is_not_packed() -> None:
    given = cloud(100)
    given.logits[:40] = -6.0  # an opacity of 1/404
    given.means[50] = torch.nan
    given.rotations[60] = 0
    kept = packed(given)
    assert kept is not None
    assert int((kept.values[:, 10] > -30).sum()) == 100 - 42 - int((given.logits[40:] <= -5.54).sum())
    assert packed(given[:40]) is None
    seen, background = splat_camera(camera(), near=0.1), torch.rand(3)
    nothing = PreparedGaussians(given[:40], RASTERISER)
    for _ in range(3):
        torch.testing.assert_close(nothing.draw(seen, 1, background)[0], background.expand(33, 33, 3))


def test_one_far_away_does_not_matter() -> None:
    given = cloud(500)
    given.means[7] = 1e9
    seen, background = splat_camera(camera(), near=0.1), torch.rand(3)
    redrawn = PreparedGaussians(given, RASTERISER)
    first, _, third = (redrawn.draw(seen, 1, background)[0] for _ in range(3))
    torch.testing.assert_close(first, third, atol=1e-6, rtol=0)


def test_a_model_forgets_when_it_changes(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("gaussian-splatting", shared_tiny, tmp_path / "run", max_num_iterations=6)
    model, view, black = trainer.model, View(camera()), torch.zeros(3)

    def look() -> torch.Tensor:
        for _ in range(2):
            shown = model.render_rgb(view, black)
        return shown

    before = look()
    trainer.train()
    after = look()
    assert not torch.allclose(before, after, atol=1e-3)
    torch.testing.assert_close(after, model.render_view(view, black).rgb, atol=1e-5, rtol=0)
    model.set_gaussians(dataclasses.replace(ball(), harmonics=torch.zeros(1, 3, 15)))
    torch.testing.assert_close(look(), model.render_view(view, black).rgb, atol=1e-5, rtol=0)


@pytest.mark.medium
@pytest.mark.parametrize("method", ["gaussian-splatting", "instant-ngp"])
def test_frames_are_measured(method: str, shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer(method, shared_tiny, tmp_path / "run", max_num_iterations=3)
    trainer.train()
    rows = measure(trainer.folder, (20, 30), (1, 2), 3)
    assert [(row.width, row.height, row.threads) for row in rows] == [
        (20, 20, 1),
        (20, 20, 2),
        (30, 30, 1),
        (30, 30, 2),
    ]
    assert all((row.num_gaussians is not None) == (method == "gaussian-splatting") for row in rows)
    for row in rows:
        assert 0 < row.median <= row.slowest
        assert row.per_second == pytest.approx(1 / row.median, rel=1)
        assert sum(row.kernels.values()) <= 3 * row.slowest

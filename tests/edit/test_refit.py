"""Refitting after a reduction: the Gaussians that are left look more like all of them, the same each time."""

from pathlib import Path

import pytest
import torch

from nerfloom import edit
from nerfloom.base.errors import ConfigError
from nerfloom.edit.edited import Edited
from nerfloom.edit.sightings import training_views
from nerfloom.splats.drawing import draw_colors
from tests.edit.clouds import ball_in_capture, scattered


def error(found: Edited, whole: Edited) -> float:
    """Mean squared difference of pictures from the cameras of the photographs."""
    assert whole.loaded is not None
    black, total = torch.zeros(3), 0.0
    for camera in training_views(whole.loaded, whole.look):
        first, second = (draw_colors(each.in_scene(), camera, 1, black) for each in (found, whole))
        total += float((first - second).square().mean())
    return total


@pytest.mark.medium
def test_what_is_left_looks_more_like_all_of_them(tmp_path: Path) -> None:
    """This holds in a frame that steps have moved, too. The Gaussians hardly change their places."""
    whole = edit.scale(edit.move(ball_in_capture(tmp_path), (3.0, 0.0, -2.0)), 0.2)
    fewer, refitted = edit.reduce_to(whole, 150), edit.reduce_to(whole, 150, refit_steps=500)
    assert len(refitted) == len(fewer) == 150
    before, after = error(fewer, whole), error(refitted, whole)
    print(f"mean squared difference of pictures: {before:.4f} before, {after:.4f} after")
    assert after < 0.7 * before
    moved = (refitted.gaussians.means - fewer.gaussians.means).norm(dim=-1)
    assert float(moved.max()) < 0.2 * 0.5  # the ball's radius
    again = edit.reduce_to(whole, 150, refit_steps=500)
    assert torch.equal(again.gaussians.means, refitted.gaussians.means)


def test_refitting_needs_photographs() -> None:
    with pytest.raises(ConfigError, match="refit_steps needs the photographs"):
        edit.reduce_to(scattered(), 10, refit_steps=5)


def test_gaussians_that_are_all_kept_are_not_refitted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = ball_in_capture(tmp_path)
    assert edit.reduce_to(whole, len(whole), refit_steps=5) is whole
    assert "nothing is refitted" in capsys.readouterr().err

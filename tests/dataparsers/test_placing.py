"""Scenes that long lenses see from afar are enlarged; others are placed as nerfstudio places them."""

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from nerfloom.cameras.poses import enlargement, nearest_point
from nerfloom.dataparsers.llff import Llff
from nerfloom.dataparsers.nerfstudio import Nerfstudio
from tests.dataparsers.captures import FX, FY, write_capture


def ring(count: int, outwards: bool = False) -> Tensor:
    """Poses (count, 3, 4) on a circle of radius 1, 1 above its centre, which they look at; or away from it."""
    angles = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    places = torch.stack([angles.cos(), angles.sin(), torch.ones(count, dtype=torch.float64)], dim=-1)
    back = torch.nn.functional.normalize(-places if outwards else places, dim=-1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(count, 3)
    right = torch.nn.functional.normalize(torch.linalg.cross(up, back), dim=-1)
    return torch.stack([right, torch.linalg.cross(back, right), back, places], dim=-1)


def spreads(count: int, value: float) -> Tensor:
    return torch.full((count,), value, dtype=torch.float64)


def test_a_place_that_long_lenses_show_is_enlarged_until_an_image_shows_one_unit_of_it() -> None:
    """The distance is the root of 2, by hand."""
    for spread in (0.01, 0.1, 0.3):
        assert enlargement(ring(12), spreads(12, spread)) == pytest.approx(1 / (math.sqrt(2) * spread))
    assert enlargement(ring(12), spreads(12, 0.36)) == 1  # which shows 0.509


def test_what_cameras_see_enough_of_or_do_not_look_at_together_stays() -> None:
    assert enlargement(ring(12, outwards=True), spreads(12, 0.1)) == 1  # a room
    aside = ring(20)
    aside[:3, :, :3] = ring(20, outwards=True)[:3, :, :3]  # three of twenty look away
    assert enlargement(aside, spreads(20, 0.1)) == 1
    along = torch.eye(3, 4, dtype=torch.float64).expand(5, 3, 4).clone()
    along[:, 0, 3] = torch.linspace(-1, 1, 5, dtype=torch.float64)
    assert enlargement(along, spreads(5, 0.1)) == 1  # side by side, as along a street
    for bad in (0.0, math.nan, math.inf):
        assert enlargement(ring(12), spreads(12, bad)) == 1


def test_a_capture_by_long_lenses_is_enlarged_in_every_split(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = Nerfstudio().parse(write_capture(tmp_path / "plain"), "train")
    folder = write_capture(tmp_path / "long", fl_x=20 * FX, fl_y=20 * FY)
    capsys.readouterr()
    train, held_out = (Nerfstudio().parse(folder, split) for split in ("train", "val"))  # type: ignore[arg-type]
    factor = train.scale / plain.scale
    said = capsys.readouterr().err
    assert factor > 2
    assert said.count(f"it is enlarged by {factor:.1f} (--auto-scale-poses)") == 1
    assert held_out.scale == train.scale
    everything = Nerfstudio(eval_mode="all")
    cameras = everything.parse(folder, "train").cameras
    origins = cameras.camera_to_worlds[:, :, 3].double()
    focus = nearest_point(origins, -cameras.camera_to_worlds[:, :, 2].double())
    shown = (focus - origins).norm(dim=-1) * torch.maximum(cameras.widths / cameras.fx, cameras.heights / cameras.fy)
    assert shown.median().item() == pytest.approx(1, rel=0.02)  # from where they stand, not along their axes
    assert Nerfstudio(auto_scale_poses=False).parse(folder, "train").scale == 1
    assert Nerfstudio(scale_factor=0.5).parse(folder, "train").scale == pytest.approx(train.scale / 2)


@pytest.mark.data
@pytest.mark.parametrize(("name", "enlarged"), [("statue_of_liberty", 4.7), ("fern", 1.0)])
def test_real_captures(name: str, enlarged: float, real_data: Path) -> None:
    """Nerfstudio's scale has the furthest camera at 1 along an axis."""
    scenes = [Llff().parse(real_data / name, split) for split in ("train", "val")]  # type: ignore[arg-type]
    furthest = max(scene.cameras.camera_to_worlds[:, :, 3].abs().max().item() for scene in scenes)
    assert furthest == pytest.approx(enlarged, abs=0.05)

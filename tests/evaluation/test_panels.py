"""Pictures for people: every part is where its label says, whole, and legible however small the view."""

import matplotlib
import numpy as np
import pytest
import torch
from torch import Tensor

from nerfloom.evaluation.images import ERROR_AT_WHITE
from nerfloom.evaluation.panels import VIRIDIS, composed, depth_range, view_panels, viridis
from nerfloom.rendering.outputs import NORMALS
from nerfloom.rendering.rendered import Picture


def view(height: int, width: int) -> tuple[Tensor, Tensor, Picture]:
    """Render, photograph and picture: solid on the left, and nothing, infinitely far away, on the right."""
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(height, width, 3, generator=generator)
    solid = (torch.arange(width) < width // 2).float().expand(height, width)
    depth = torch.where(solid > 0, torch.linspace(2, 4, height)[:, None], torch.inf)
    rendered = (target + ERROR_AT_WHITE).clamp(0, 1)
    facing = torch.tensor([0.0, 0.0, 1.0]).expand(height, width, 3)
    return rendered, target, Picture(rendered, depth, depth, solid, {"normals": facing}, (NORMALS,))


def boxes(picture: Tensor, height: int, width: int, count: int) -> list[Tensor]:
    """The parts, found by the grey frames around them."""
    grey = (picture * 255).round() == torch.tensor([190.0, 190.0, 190.0])
    rows = grey.all(-1).sum(1)
    top = int((rows >= count * width).nonzero()[0]) + 1  # the first line that is frame along all parts
    columns = grey.all(-1)[top : top + height].all(0).nonzero().flatten().tolist()
    assert len(columns) == 2 * count
    return [
        picture[top : top + height, left + 1 : right] for left, right in zip(columns[::2], columns[1::2], strict=True)
    ]


@pytest.mark.parametrize(("height", "width", "factor"), [(24, 24, 7), (3, 5, 32), (200, 160, 1), (90, 400, 1)])
def test_every_part_is_there_whole_between_gaps(height: int, width: int, factor: int) -> None:
    panels = view_panels(*view(height, width))
    labels = ["photograph", "render", "error", "depth, scene units", "opacity", "normals"]
    assert [panel.label for panel in panels] == labels
    found = boxes(composed(panels), height * factor, width * factor, 6)
    for panel, part in zip(panels, found, strict=True):
        expected = panel.image.repeat_interleave(factor, 0).repeat_interleave(factor, 1)
        torch.testing.assert_close(part, expected, atol=0.6 / 255, rtol=0)


def test_labels_and_ranges_are_written_in_the_margins() -> None:
    """There is ink above every part, and below parts with a colour bar; without words there is none."""
    panels = view_panels(*view(24, 24))
    picture = composed(panels)
    dark = (picture < 0.3).all(-1)
    gap = 12
    for index, panel in enumerate(panels):
        left = gap + index * (168 + gap)
        above, below = dark[:19, left : left + 168], dark[-24:, left : left + 168]
        assert int(above.sum()) > 40
        assert (int(below.sum()) > 10) == (panel.bar is not None)


def test_the_error_reaches_white_and_depth_its_ends() -> None:
    _, target, picture = view(50, 20)
    depth, solid = picture.median_depth, picture.accumulation
    flat = torch.full_like(target, 0.5)
    error, depths = view_panels(flat + ERROR_AT_WHITE, flat, picture)[2:4]
    assert bool((error.image == 1).all())
    assert error.ends == ("0", "0.25 or more")
    near, far = depth_range(depth, solid > 0.5)
    assert (near, far) == pytest.approx((2.04, 3.96), abs=0.01)
    assert depths.ends == ("2.04", "3.96")
    torch.testing.assert_close(depths.image[0, 0], VIRIDIS[0])
    torch.testing.assert_close(depths.image[-1, 0], VIRIDIS[-1])
    assert bool((depths.image[:, 10:] == 1).all())  # where nothing is


def test_a_view_of_nothing_has_no_depth() -> None:
    nothing = torch.zeros(8, 8)
    white, unknown = torch.ones(8, 8, 3), nothing + torch.nan
    picture = composed(view_panels(white, white, Picture(white, unknown, unknown, nothing)))
    assert bool(torch.isfinite(picture).all())
    assert depth_range(nothing + torch.inf, nothing > 1) == (0.0, 0.0)


def test_viridis_is_matplotlibs() -> None:
    values = torch.linspace(0, 1, 101)
    expected = matplotlib.colormaps["viridis"](values.numpy())[:, :3]
    assert np.abs(viridis(values).numpy() - expected).max() < 0.03

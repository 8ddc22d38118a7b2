"""Outputs of a view: colours and numbers worked out by hand."""

import numpy as np
import pytest
import torch

from nerfloom.base.errors import ConfigError
from nerfloom.evaluation.outputs import (
    ERROR,
    PHOTOGRAPH,
    chosen_outputs,
    distance_range,
    kept_outputs,
    largest_distance,
    opaque_distance,
    shown_output,
    side_by_side,
)
from nerfloom.rendering.outputs import DEPTH, FIXED, NORMALS, Output
from nerfloom.rendering.rendered import Picture

DOUBT = Output("doubt", "scalar")


def picture(**changes: object) -> Picture:
    """Two pixels: an opaque one at 2, and an empty one at 1000."""
    values = {
        "rgb": torch.tensor([[[0.5, 0.25, 0.0], [1.0, 1.0, 1.0]]]),
        "depth": torch.tensor([[2.0, 1000.0]]),
        "median_depth": torch.tensor([[2.5, 1000.0]]),
        "accumulation": torch.tensor([[1.0, 0.0]]),
        "extras": {"normals": torch.tensor([[[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]]), "doubt": torch.tensor([[3.0, 9.0]])},
    }
    return Picture(**{**values, **changes})  # type: ignore[arg-type]


def test_every_output_has_a_picture() -> None:
    truth = torch.tensor([[[0.5, 0.25, 0.25 * 3], [1.0, 1.0, 1.0]]])  # off by 0.75 in one of three channels
    outputs = (*FIXED, NORMALS, DOUBT, ERROR, PHOTOGRAPH)
    kept = kept_outputs(picture(), outputs, 0.5, truth)
    ranges = {"depth": (0.0, 1.0), "median_depth": (0.0, 2.5), "doubt": (0.0, 3.0)}
    shown = {output.name: shown_output(kept, output.name, ranges).tolist() for output in outputs}
    assert shown["rgb"] == [[[128, 64, 0], [255, 255, 255]]]
    assert shown["gt-rgb"] == [[[128, 64, 191], [255, 255, 255]]]
    assert shown["error"] == [[[255, 255, 255], [0, 0, 0]]]  # 0.25 on average is white
    assert shown["accumulation"] == [[[255] * 3, [0] * 3]]
    assert shown["normals"] == [[[128, 128, 255], [255] * 3]]
    assert shown["doubt"] == [[[253, 231, 37], [255] * 3]]
    assert shown["depth"] == [[[253, 231, 37], [255] * 3]]  # the light end of viridis, and white for nothing
    assert shown["median_depth"] == [[[33, 145, 141], [255] * 3]]  # 1.25 of 2.5: its middle, #21918c, but for rounding
    assert side_by_side([np.array(shown["rgb"]), np.array(shown["normals"])]).shape == (1, 4, 3)


def test_distances_are_in_units_of_the_input() -> None:
    kept = kept_outputs(picture(), [DEPTH], 3.0)
    assert set(kept) == {"depth", "accumulation"}
    assert opaque_distance(kept, "depth").tolist() == [[6.0, 0.0]]
    infinite = kept_outputs(picture(depth=torch.tensor([[torch.inf, 1.0]])), [DEPTH], 3.0)
    assert opaque_distance(infinite, "depth").tolist() == [[0.0, 0.0]]


def test_the_range_is_that_of_all_frames_and_of_surfaces_alone() -> None:
    solid = torch.ones(1, 2)
    frames = [
        kept_outputs(picture(depth=torch.tensor(depths), accumulation=opacity), [DEPTH], 1.0)
        for depths, opacity in (([[2.0, 3.0]], solid), ([[1.0, 2.0]], solid), ([[0.1, 99.0]], 0 * solid))
    ]
    assert distance_range(frames, "depth") == (1.0, 3.0)
    assert largest_distance(frames, "depth") == 3.0
    assert distance_range(frames[2:], "depth") == (0.0, 1.0)
    assert largest_distance(frames[2:], "depth") == 0.0


def test_what_a_method_has_not_is_refused() -> None:
    class Doubts:
        outputs = (DOUBT,)

    assert chosen_outputs(Doubts(), ["doubt", "depth", "error"]) == [DOUBT, DEPTH, ERROR]
    with pytest.raises(ConfigError, match=r"no such output; it has rgb, .*, doubt, .*--predict-normals True"):
        chosen_outputs(Doubts(), ["normals"])
    for output in (ERROR, PHOTOGRAPH):
        with pytest.raises(ConfigError, match="only 'ns-render dataset' has true images"):
            kept_outputs(picture(), [output], 1.0)

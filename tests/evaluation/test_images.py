"""Pictures: an independent reader reads back the written files."""

from pathlib import Path

import numpy as np
import torch
from PIL import Image

from nerfloom.evaluation.images import ERROR_AT_WHITE, error_map, heat, write_image


def test_a_written_image_reads_back_rounded(tmp_path: Path) -> None:
    image = torch.tensor([[[0.0, 0.5, 1.0], [1.5, -1.0, 0.2]]])
    write_image(tmp_path / "new" / "a.png", image)
    with Image.open(tmp_path / "new" / "a.png") as read:
        assert [read.getpixel((0, 0)), read.getpixel((1, 0))] == [(0, 128, 255), (255, 0, 51)]


def test_heat_runs_from_black_over_red_and_yellow_to_white() -> None:
    colors = heat(torch.tensor([[0.0, 1 / 3, 2 / 3, 1.0]]))[0]
    expected = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 1, 1]])
    torch.testing.assert_close(colors, expected, atol=1e-6, rtol=0)


def test_an_error_map_is_white_where_the_error_is_as_stated() -> None:
    target = np.zeros((1, 3, 3), np.uint8)
    prediction = np.array([[[0] * 3, [round(255 * ERROR_AT_WHITE)] * 3, [28, 0, 0]]], np.uint8)
    third = round(3 * 28 / 3 / 255 / ERROR_AT_WHITE * 255)  # of black to red
    assert error_map(prediction, target).tolist() == [[[0, 0, 0], [255, 255, 255], [third, 0, 0]]]

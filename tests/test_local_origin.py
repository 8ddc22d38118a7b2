"""When float32 is too coarse for coordinates: by its 24 bits, the spread of the points, and nothing else."""

import json
import math
from pathlib import Path

import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.data.offsets import offset_file, read_offset, write_offset
from nerfloom.geometry.local_origin import local_origin, rounding

UTM = torch.tensor([512345.678, 5403210.987, 432.1], dtype=torch.float64)
"""A place on Earth in metres."""


def cube(count: int = 2001) -> torch.Tensor:
    """Points (count, 3) float64 in a cube of edge 2 around the origin."""
    return 2 * torch.rand(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 1


@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e5, 5e6])
def test_the_unit_does_not_matter_but_the_distance_does(unit: float) -> None:
    """Points in a cube get the same answer in every unit, and another origin beyond some 130 edges of it."""
    for away, is_far in ((0.0, False), (30.0, False), (100.0, False), (200.0, True), (1e6, True)):
        points = unit * (cube() + torch.tensor([away, -away / 2, 0.0]))
        origin = local_origin(points)
        assert (origin is not None) == is_far
        if origin is not None:
            local = points - origin
            assert local.abs().max() < 3 * unit
            back = local.float().double() + origin
            assert (back - points).abs().max() < 2e-7 * unit + 1e-9 * away * unit


def test_the_error_is_that_of_float32() -> None:
    """Up to half a step; a value has 2^24 steps or more."""
    for away in (1.0, 130.0, 5e6):
        points = cube() + torch.tensor([away, 0.0, 0.0], dtype=torch.float64)
        error = float((points.float().double() - points).abs().max())
        assert error <= 2.0**-24 * (away + 1)
        assert rounding(points) == pytest.approx(2.0**-24 * away, rel=0.1)


def test_an_origin_can_be_read_by_people() -> None:
    """A multiple of ten metres for points some tens of metres apart."""
    origin = local_origin(40 * cube() + UTM)
    assert origin is not None
    assert origin.tolist() == [round(value, -1) for value in origin.tolist()]
    torch.testing.assert_close(origin, UTM, rtol=0, atol=10)


def test_outliers_do_not_hide_what_is_in_the_middle() -> None:
    points = cube() + UTM
    points[:400] = 1e9
    points[400] = math.nan
    origin = local_origin(points)
    assert origin is not None
    torch.testing.assert_close(origin, UTM, rtol=0, atol=2)


def test_what_is_at_a_point_has_a_size() -> None:
    one = torch.tensor([[1.0, 2.0, 3.0]])
    assert local_origin(one, size=0.1) is None
    assert local_origin(one + UTM, size=0.1) is not None
    assert local_origin(torch.zeros(0, 3)) is None
    assert local_origin(torch.zeros(3, 3)) is None  # all at the origin


def test_an_offset_lies_beside_its_file_and_goes_with_it(tmp_path: Path) -> None:
    file = tmp_path / "ball.glb"
    assert read_offset(file).tolist() == [0, 0, 0]
    sentence = write_offset(file, UTM)
    assert sentence is not None
    assert "(512345.678, 5403210.987, 432.1)" in sentence
    assert json.loads((tmp_path / "ball.glb.offset.json").read_text()) == {"offset": UTM.tolist()}
    assert torch.equal(read_offset(file), UTM)
    assert write_offset(file, None) is None  # the next file of this name is where the input is
    assert not offset_file(file).exists()
    assert write_offset(file, None) is None


@pytest.mark.parametrize(
    "content", ["", "[1, 2, 3]", "{}", '{"offset": [1, 2]}', '{"offset": [1, 2, "3"]}', '{"offset": [1, 2, 1e999]}']
)
def test_a_damaged_offset_is_refused(content: str, tmp_path: Path) -> None:
    offset_file(tmp_path / "a.spz").write_text(content)
    with pytest.raises(DataError, match=r"a\.spz\.offset\.json"):
        read_offset(tmp_path / "a.spz")

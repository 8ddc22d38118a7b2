"""Numbers of things in messages."""

import pytest

from nerfloom.base.counts import counted


@pytest.mark.parametrize(("number", "text"), [(0, "0 images"), (1, "1 image"), (2, "2 images"), (1200, "1,200 images")])
def test_one_thing_is_in_the_singular(number: int, text: str) -> None:
    assert counted(number, "images") == text

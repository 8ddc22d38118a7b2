"""Damaged files of every kind: refused in one line, or read with sense; and nothing else happens.

`python -m tests.fuzz` does the same for as long as one likes.
"""

import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.fuzz import campaign
from tests.fuzz.outcome import Outcome

pytest.importorskip("resource")
pytest.importorskip("pycolmap")
pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits of memory are those of Linux")
COUNT = 60
"""Inputs for each reader."""
READERS = (
    "blender", "dnerf", "nerfstudio", "colmap-binary", "colmap-text", "llff", "llff-ndc", "record3d", "polycam",
    "phototourism", "ply", "images", "images-to-a-file", "masks", "depths", "photographs", "polycam-raw",
    "record3d-raw", "config", "comparison", "checkpoint", "run", "pixel-cache",
)  # fmt: skip
"""Their names here too, so that tests are collected without reading anything."""


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> list[Outcome]:
    """In two processes, each with half of the readers."""
    bases = [tmp_path_factory.mktemp("fuzz") for _ in range(2)]
    with ThreadPoolExecutor(2) as pool:
        halves = [pool.submit(campaign.run, READERS[which::2], base, count=COUNT) for which, base in enumerate(bases)]
        return [outcome for half in halves for outcome in half.result()]


def test_all_readers_are_here() -> None:
    assert set(READERS) == set(campaign.names())


@pytest.mark.parametrize("reader", READERS)
def test_damaged_files_are_refused_in_a_line_or_read_with_sense(reader: str, outcomes: list[Outcome]) -> None:
    own = [outcome for outcome in outcomes if outcome.reader == reader]
    kinds = Counter(outcome.kind for outcome in own)
    print(f"{reader}: {dict(kinds)}, refused in {len({o.shape for o in own if o.kind == 'refused'})} ways")
    escapes = [str(outcome) for outcome in own if outcome.kind == "escaped"]
    assert not escapes, "\n\n".join([f"{len(escapes)} of {len(own)} inputs got through:", *escapes[:5]])
    assert len(own) == COUNT


def test_much_of_it_is_noticed(outcomes: list[Outcome]) -> None:
    """Or the damage does not reach what is read."""
    refused = sum(outcome.kind == "refused" for outcome in outcomes) / len(outcomes)
    print(f"{refused:.0%} of damaged inputs were refused")
    assert 0.2 < refused < 0.98

"""Damaged files of every kind: refused in one line, or read with sense; and nothing else happens.

`python -m tests.fuzz` does the same for as long as one likes.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.fuzz import campaign
from tests.fuzz.report import summary

pytest.importorskip("resource")
pytest.importorskip("pycolmap")
pytest.importorskip("trimesh")
pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits of memory are those of Linux")
FEW, MANY = 3, 200
"""Inputs for each reader, in the fast set and in the slow one."""
READERS = (
    "blender", "dnerf", "nerfstudio", "colmap-binary", "colmap-text", "llff", "llff-ndc", "record3d", "polycam",
    "phototourism", "ply", "surfaces", "splats", "camera-path", "images", "images-to-a-file", "masks", "depths",
    "photographs", "polycam-raw", "record3d-raw", "config", "comparison", "checkpoint", "run", "archive", "pixel-cache",
    "lpips-weights", "depths-exr", "normals", "dtu", "sdfstudio", "octree", "scale", "edits", "blocks", "metashape",
    "realitycapture", "odm", "aria", "bundler", "levels", "visibility", "diffuse-light",
)  # fmt: skip
"""Their names here too, so that tests are collected without reading anything."""
ASKED = [
    pytest.param(READERS, FEW, id="all"),
    pytest.param(READERS[::2], MANY, id="one half", marks=pytest.mark.slow),
    pytest.param(READERS[1::2], MANY, id="the other half", marks=pytest.mark.slow),
]
"""A process reads for many readers, as it takes seconds to begin."""


def test_all_readers_are_here() -> None:
    assert set(READERS) == set(campaign.names())


@pytest.mark.medium
@pytest.mark.parametrize(("readers", "count"), ASKED)
def test_damaged_files_are_refused_in_a_line_or_read_with_sense(
    readers: Sequence[str], count: int, tmp_path: Path
) -> None:
    outcomes = campaign.run(readers, tmp_path, count=count)
    print("\n".join(summary(outcomes)))
    assert [(o.seed, o.reader) for o in outcomes] == [(seed, reader) for seed in range(count) for reader in readers]
    escapes = [str(outcome) for outcome in outcomes if outcome.kind == "escaped"]
    assert not escapes, "\n\n".join([f"{len(escapes)} of {len(outcomes)} inputs got through:", *escapes[:5]])
    refused = sum(outcome.kind == "refused" for outcome in outcomes) / len(outcomes)
    assert 0.2 < refused < 0.98, f"{refused:.0%} were refused: does the damage reach the bytes that are read?"

"""Runs that were stopped, and pairs of images to match."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nerfloom.base.errors import DataError, FlagError
from nerfloom.processing.matching import choose_matching
from nerfloom.processing.output import begin, claim
from nerfloom.processing.retrieval import similar_pairs
from nerfloom.processing.settings import ColmapFlags
from nerfloom.processing.unfinished import unfinished


@pytest.fixture
def flags(tmp_path: Path) -> ColmapFlags:
    (tmp_path / "in").mkdir()
    for name in ("1.jpg", "2.jpg"):
        (tmp_path / "in" / name).write_bytes(b"12")
    return ColmapFlags(data=tmp_path / "in", output_dir=tmp_path / "out")


SOURCES = [Path("1.jpg"), Path("2.jpg")]


def test_a_stopped_run_goes_on_with_what_it_has(flags: ColmapFlags) -> None:
    begin(flags, SOURCES)
    work = unfinished(flags.output_dir)
    (work / "database.db").write_bytes(b"features")
    (work / "sparse_raw").mkdir()
    (work / "frames").mkdir()
    with pytest.raises(DataError, match="--resume continues it, --overwrite starts again"):
        claim(flags.output_dir, flags.data, False)
    begin(replace(flags, resume=True, matching_method="exhaustive", num_threads=1), SOURCES)
    assert sorted(path.name for path in work.iterdir()) == ["database.db", "frames", "started.json"]
    begin(replace(flags, overwrite=True), SOURCES)
    assert sorted(path.name for path in work.iterdir()) == ["started.json"]


def test_other_flags_or_files_cannot_go_on(flags: ColmapFlags) -> None:
    begin(flags, SOURCES)
    again = replace(flags, resume=True)
    with pytest.raises(DataError, match="--max-image-size is 800, but was 1600"):
        begin(replace(again, max_image_size=800), SOURCES)
    with pytest.raises(DataError, match=r"1 files of .* the first: 2\.jpg"):
        begin(again, SOURCES[:1])
    os.utime(flags.data / "1.jpg", (1, 1))
    with pytest.raises(DataError, match=r"the first: 1\.jpg"):
        begin(again, SOURCES)
    with pytest.raises(FlagError, match="leave out one of them"):
        replace(again, overwrite=True).check()


def test_resume_without_a_stopped_run_begins(flags: ColmapFlags) -> None:
    begin(replace(flags, resume=True), SOURCES)
    assert (unfinished(flags.output_dir) / "started.json").is_file()


def test_ordered_images_are_matched_in_order() -> None:
    assert choose_matching("auto", 82, 150, ordered=True) == "sequential"
    assert choose_matching("auto", 82, 150, ordered=False) == "exhaustive"
    assert choose_matching("auto", 151, 150, ordered=False) == "retrieval"
    assert choose_matching("exhaustive", 900, 150, ordered=True) == "exhaustive"


def test_loops_are_looked_for_away_from_neighbours() -> None:
    """A circle of 40 views is walked twice: views 20 apart are alike, and neighbours even more so."""
    angles = np.arange(40) * 2 * np.pi / 20
    descriptors = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    assert {abs(j - i) for i, j in similar_pairs(descriptors, 2)} <= {0, 1, 19, 20, 21, 39}
    assert {(i, i + 20) for i in range(20)} <= set(similar_pairs(descriptors, 1, apart=5))
    assert min(j - i for i, j in similar_pairs(descriptors, 5, apart=5)) > 5

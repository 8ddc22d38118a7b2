"""Building out of core: every Gaussian is in one leaf, boxes and errors hold, and the memory is bounded."""

import math
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from nerfloom.base.errors import DataError, FlagError
from nerfloom.levels import building
from nerfloom.levels.buckets import bucket_of, splits
from nerfloom.levels.building import build_levels
from nerfloom.levels.files import read_levels, row_size
from nerfloom.levels.on_image import reaches
from nerfloom.splats.gaussians import Gaussians, Splats
from nerfloom.splats.look import OURS, Look
from nerfloom.splats.stream import GaussianStream
from tests.levels.made import CHUNK, built, cloud, leaves

ORIGIN = torch.zeros(3, dtype=torch.float64)


def in_order(gaussians: Gaussians) -> torch.Tensor:
    """All numbers of Gaussians, sorted by their first centre."""
    columns = [values.reshape(len(gaussians), -1) for values in gaussians.columns.values()]
    rows = torch.cat(columns, 1)
    return rows[np.lexsort(rows[:, :3].numpy().T).tolist()]


def test_each_gaussian_is_in_one_leaf_as_it_was(tmp_path: Path) -> None:
    given = cloud()
    file = built(tmp_path / "x.levels", given, look=Look(True, 0.1, "depth"))
    found = Gaussians.joined([file.read(index) for index in leaves(file)])
    assert torch.equal(in_order(found), in_order(given))
    assert (file.num_gaussians, file.degree, file.look) == (3000, 1, Look(True, 0.1, "depth"))
    assert not file.origin.any()
    assert list(tmp_path.iterdir()) == [tmp_path / "x.levels"]  # no bucket is left


def test_boxes_reaches_and_errors_hold_for_all_below(tmp_path: Path) -> None:
    file = built(tmp_path / "x.levels", cloud())
    nodes = file.nodes
    assert len(nodes) == 2 * len(leaves(file)) - 1
    assert int(nodes.counts.max()) <= CHUNK
    for index in range(len(nodes)):
        chunk, at = file.read(index), index
        while at >= 0:
            centers = chunk.means.double()
            assert bool(((centers >= nodes.low[at]) & (centers <= nodes.high[at])).all())
            assert float(reaches(chunk.logits, chunk.log_scales).max()) <= float(nodes.reach[at])
            at = int(nodes.parents[at])
    assert not nodes.errors[leaves(file)].any()
    inner = ~nodes.is_leaf
    assert bool((nodes.errors[inner] > 0).all())
    for index in inner.nonzero()[:, 0].tolist():
        below = nodes.counts[nodes.parents == index]
        assert len(below) == 2
        assert int(below.sum()) / 4 <= int(nodes.counts[index]) <= int(below.sum()) / 2


def test_reach_is_where_alpha_is_that_of_a_step() -> None:
    given = cloud(5)
    away = reaches(given.logits, given.log_scales)
    alpha = torch.sigmoid(given.logits) * torch.exp(-0.5 * (away / given.log_scales.exp().amax(1)).square())
    torch.testing.assert_close(alpha, torch.full((5,), 1 / 255, dtype=torch.float64), rtol=1e-4, atol=0)


def test_many_at_one_place_and_few_of_them(tmp_path: Path) -> None:
    """No plane parts them, and they fit into memory only in pieces."""
    given = cloud(1500)
    given.means[:1400] = 0.25
    file = built(tmp_path / "x.levels", given, memory=0.3)
    found = Gaussians.joined([file.read(index) for index in leaves(file)])
    assert torch.equal(found.logits.sort().values, given.logits.sort().values)
    assert int(file.nodes.counts.max()) <= CHUNK
    for count in (1, 2, 5):
        assert built(tmp_path / "few.levels", cloud(count)).num_gaussians == count


def test_what_cannot_be_drawn_is_left_out(tmp_path: Path) -> None:
    """A centre in float64 may be finite and too far away for float32."""
    given = Gaussians.of({**cloud(500).columns, "means": cloud(500).means.double()})
    given.means[3] = torch.nan
    given.means[5] = 1e300
    given.rotations[7] = 0
    given.log_scales[9] = 1000.0
    given.log_scales[11] = 88.0
    stream = GaussianStream.of(Splats(given, OURS))
    assert build_levels(tmp_path / "x.levels", stream, ORIGIN, CHUNK, 32, 0.5) == 5
    assert read_levels(tmp_path / "x.levels").num_gaussians == 495
    nothing = GaussianStream.of(Splats(given[3:4], OURS))
    with pytest.raises(DataError, match="no Gaussians"):
        build_levels(tmp_path / "none.levels", nothing, ORIGIN, CHUNK, 32, 0.5)
    wrong = [(5, 0.5, "--chunk-size"), *((CHUNK, memory, "--build-memory") for memory in (0.1, 0.0, np.nan, np.inf))]
    for chunk_size, memory, flag in wrong:
        with pytest.raises(FlagError, match=flag):
            build_levels(tmp_path / "none.levels", stream, ORIGIN, chunk_size, 32, memory)
    assert list(tmp_path.iterdir()) == [tmp_path / "x.levels"]


def test_a_file_has_no_more_nodes_than_can_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The number of nodes is known only afterwards, and is at most the one that is expected."""
    stream = GaussianStream.of(Splats(cloud(1000), OURS))
    for chunk_size, memory in ((16, 0.1), (100, 0.5)):
        monkeypatch.setattr(building, "MAX_NODES", math.ceil(building.MOST_NODES * 1000 / chunk_size))
        build_levels(tmp_path / "x.levels", stream, ORIGIN, chunk_size, 32, memory)
        assert len(read_levels(tmp_path / "x.levels").nodes) <= building.MAX_NODES
        monkeypatch.setattr(building, "MAX_NODES", building.MAX_NODES // 2)
        with pytest.raises(FlagError, match="1,000 Gaussians need at least"):
            build_levels(tmp_path / "x.levels", stream, ORIGIN, chunk_size, 32, memory)


def test_parts_of_other_degrees_and_far_from_the_origin(tmp_path: Path) -> None:
    """Centres in float64, in metres on Earth: millimetres are kept by an origin near them."""
    survey = torch.tensor([512345.678, 5403210.987, 432.1], dtype=torch.float64)
    parts = [Gaussians.of({**cloud(300, degree).columns, "means": cloud(300).means + survey}) for degree in (0, 2)]
    stream = GaussianStream(lambda most: (some for part in parts for some in part.sliced(most)), OURS)
    build_levels(tmp_path / "x.levels", stream, torch.tensor([1.0, 2.0, 3.0]).double(), CHUNK, 32, 1.0)
    file = read_levels(tmp_path / "x.levels")
    assert (file.degree, file.num_gaussians) == (2, 600)
    found = torch.cat([file.read(index).means.double() + file.origin for index in leaves(file)])
    expected = torch.cat([part.means for part in parts]) + torch.tensor([1.0, 2.0, 3.0])
    order, other = found[:, 0].argsort(), expected[:, 0].argsort()
    torch.testing.assert_close(found[order], expected[other], rtol=0, atol=1e-4)
    assert sum(int((file.read(index).harmonics == 0).all((1, 2)).sum()) for index in leaves(file)) == 300


def test_a_tree_of_planes_has_equal_cells() -> None:
    points = torch.rand(4096, 3, generator=torch.Generator().manual_seed(0)).numpy()
    axes, values = splits(points, 5)
    cells = bucket_of(points, axes, values)
    assert np.bincount(cells, minlength=32).tolist() == [128] * 32
    first = points[cells < 16], points[cells >= 16]
    assert first[0][:, axes[0]].max() <= values[0] < first[1][:, axes[0]].min()
    assert bucket_of(points, *splits(points, 0)).tolist() == [0] * 4096


@pytest.mark.medium
def test_200_000_gaussians_are_built_within_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """numpy tells tracemalloc of its arrays; the tensors are the parts of the stream and the merged Gaussians."""
    count, chunk, memory, lengths = 200_000, 2000, 8.0, list[int]()

    def parts(most: int) -> Iterator[Gaussians]:
        random = torch.Generator().manual_seed(0)
        for first in range(0, count, most):
            lengths.append(min(most, count - first))
            yield cloud(lengths[-1], 1, random)

    def merging(gaussians: Gaussians, errors: torch.Tensor) -> tuple[Gaussians, torch.Tensor]:
        lengths.append(len(gaussians))
        return halved(gaussians, errors)

    halved = building.halved
    monkeypatch.setattr(building, "halved", merging)
    tracemalloc.start()
    try:
        build_levels(tmp_path / "x.levels", GaussianStream(parts, OURS), ORIGIN, chunk, 16, memory)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    file = read_levels(tmp_path / "x.levels")
    whole = count * row_size(1, 32)
    print(
        f"arrays of {peak / 1e6:.1f} MB at most, tensors of {max(lengths):,} Gaussians, of {whole / 1e6:.1f} MB in all"
    )
    assert file.num_gaussians == count
    assert int(file.nodes.counts.max()) <= chunk
    assert peak + 4 * max(lengths) * row_size(1, 32) < 1e6 * memory < whole / 2
    assert max(lengths) <= 2 * chunk

"""Files of octrees: written files are read, bytes lose no more than allowed, and hostile files are refused."""

import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics_reference
from nerfloom.kernels.octree.light import depths_of, raw_of
from nerfloom.kernels.octree.packed import trace_packed
from nerfloom.kernels.octree.trace import trace_octree
from nerfloom.octrees.files import NAMES, read_octree, write_octree
from nerfloom.octrees.packing import CLIPPED, MAX_DEPTH, packed
from tests.octrees.balls import ball, boxes


def arrays_of(file: Path) -> dict[str, np.ndarray]:
    with np.load(file, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive}


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_what_is_written_is_read(tmp_path: Path, degree: int) -> None:
    octree = ball(degree)
    write_octree(tmp_path / "x.octree", octree)
    assert set(arrays_of(tmp_path / "x.octree")) == set(NAMES)
    found = read_octree(tmp_path / "x.octree")
    for part in ("layout", "leaves"):
        for name, value in vars(getattr(octree, part)).items():
            other = getattr(getattr(found, part), name)
            assert torch.equal(value, other) if isinstance(value, torch.Tensor) else value == other, name
    assert (found.near, found.far, found.has_alpha, found.image_size) == (0.1, 10.0, True, 400)
    assert torch.equal(found.placement.transform, octree.placement.transform)
    assert found.placement.scale == 0.25
    torch.testing.assert_close(found.scene.box, torch.tensor([[-0.8] * 3, [0.8] * 3]))


def test_boxes_around_one_another_are_written_and_read(tmp_path: Path) -> None:
    octree = boxes()
    write_octree(tmp_path / "x.octree", octree)
    found = read_octree(tmp_path / "x.octree")
    assert len(found.layout.levels) == 3
    assert found.scene.unbounded
    for one, two in zip(octree.layout.levels, found.layout.levels, strict=True):
        assert one.cell == two.cell
        for name in ("origin", "bricks", "masks", "firsts"):
            assert torch.equal(getattr(one, name), getattr(two, name)), name
    assert torch.equal(found.leaves.table, octree.leaves.table)
    assert torch.equal(found.leaves.codes, octree.leaves.codes)


def test_rounding_to_bytes_loses_what_it_says() -> None:
    torch.manual_seed(0)
    depths = torch.cat([torch.rand(1000), torch.exp(3 * torch.randn(1000)), torch.zeros(5)])
    coefficients = torch.randn(2005, 12)
    for bits in (8, 6, 4):
        leaves, lost = packed(depths, coefficients, bits)
        opacity = (torch.exp(-depths) - torch.exp(-leaves.depths())).square().mean().sqrt()
        assert lost.opacity == pytest.approx(float(opacity))
        steps = 2**bits - 1
        # tau / (1 + tau) is rounded to half a step; its slope is largest, (1 + tau)^2, where opacity has saturated.
        share = depths.clamp(max=MAX_DEPTH) / (1 + depths.clamp(max=MAX_DEPTH))
        again = leaves.depths() / (1 + leaves.depths())
        assert float((share - again).abs().max()) <= 0.5 / steps + 1e-6
        error = (leaves.coefficients() - coefficients).abs()
        inside = (coefficients >= leaves.offsets) & (coefficients <= leaves.offsets + steps * leaves.scales)
        assert bool((error <= leaves.scales / 2 + 1e-5)[inside].all())
        print(f"{bits} bits: opacity {lost.opacity:.2g}, colour {lost.color:.2g}")
    assert not leaves.depths()[-5:].any()
    assert len(packed(torch.zeros(0), torch.zeros(0, 3))[0].codes) == 0


@pytest.mark.parametrize("bits", [8, 6, 4])
def test_a_picture_loses_half_a_step_of_each_harmonic_at_most(bits: int) -> None:
    """The weights of a ray sum to 1 at most, so its colour errs by no more than a leaf's."""
    torch.manual_seed(bits)
    octree, degree = ball(2), 2
    count = octree.layout.num_leaves
    exact = torch.rand(count, 3 * (degree + 1) ** 2) - 0.5
    leaves = replace(
        packed(octree.leaves.depths(), exact, bits)[0], codes=octree.leaves.codes, table=octree.leaves.table
    )
    directions = torch.nn.functional.normalize(torch.randn(500, 3), dim=-1)
    rays = Rays(0.1 * torch.randn(500, 3) - 3 * directions, directions)
    found = trace_packed(octree.layout, leaves, rays, torch.ones(3)).color
    raw = raw_of(octree.leaves.depths())[:, None]
    truth = trace_octree(octree.layout, raw, exact, rays, torch.ones(3)).color
    basis = spherical_harmonics_reference(directions, degree + 1).abs()
    # A share of the values at both ends of the range is clipped; values here are uniform, so by about that share.
    steps = leaves.scales.view(3, -1) * (0.5 + 2 * CLIPPED * 2**bits)
    bound = basis @ steps.T + 1e-4
    errors = (found - truth).abs()
    print(f"{bits} bits: at most {float(errors.max()):.2g} of {float(bound.max()):.2g}")
    assert bool((errors <= bound).all())
    assert float(errors.max()) > 0.02 * float(bound.max())


def test_fewer_bits_make_a_file_smaller(tmp_path: Path) -> None:
    octree, sizes = ball(2), []
    exact = torch.rand(octree.layout.num_leaves, 27)
    for bits in (8, 6, 4):
        file = tmp_path / f"{bits}.octree"
        write_octree(file, replace(octree, leaves=packed(octree.leaves.depths(), exact, bits)[0]))
        sizes.append(file.stat().st_size)
    print(sizes)
    assert sizes[1] < 0.8 * sizes[0]
    assert sizes[2] < 0.8 * sizes[1]


def test_damaged_and_hostile_files(tmp_path: Path) -> None:
    file = tmp_path / "x.octree"
    write_octree(file, ball())
    good = arrays_of(file)

    def refused(because: str, **changes: object) -> None:
        with file.open("wb") as stream:  # a name would get another suffix
            np.savez(stream, **{name: value for name, value in (good | changes).items() if value is not None})
        with pytest.raises(DataError, match=because) as error:
            read_octree(file)
        assert "\n" not in str(error.value)

    count = good["codes"].shape[0]
    refused("no array 'masks'", masks=None)
    refused("no array 'version'", version=None)
    refused("x.octree has version 1 of the format, and 2 is known; bake it again", version=1, bricks=None)
    refused("has version 3", version=3, more=np.zeros(2))
    refused("masks", masks=good["masks"].astype(np.float64))
    refused("codes", codes=good["codes"][:-1])
    refused("colors", colors=good["colors"][:, :-1])
    refused("shape", masks=np.zeros_like(good["masks"]))
    refused("coefficients", scales=good["scales"][:5])
    refused("not finite", scales=np.full(12, np.nan, np.float32))
    refused("negative", table=-good["table"] - 1)
    refused("in 2 boxes", bricks=np.append(good["bricks"], 1))
    refused("in 0 boxes", bricks=good["bricks"][:0])
    refused("'table'", bricks=np.append(good["bricks"], 0))
    refused("'bricks'", bricks=-good["bricks"])
    refused("'cell'", cell=np.nan)
    refused("'cell'", cell=-1.0)
    refused("size", size=np.array([0, 4, 4]))
    refused("too large", size=np.array([2**15, 2**15, 4]))
    refused("'size'", size=np.array([2**17, 1, 1]))  # places have 16 bits
    refused(f"its masks have {64 * good['masks'].size:,} leaves", masks=np.full_like(good["masks"], 2**64 - 1))
    refused("outside", places=good["places"] + np.uint16(60_000))
    refused("order", places=good["places"][::-1].copy(), masks=good["masks"][::-1].copy())
    refused("order", places=np.repeat(good["places"][:1], len(good["places"]), 0))
    refused("ends before", near=11.0)
    refused("rigid", transform=np.zeros((3, 4)))
    refused("rigid", transform=np.diag([2.0, 0.5, 1.0, 0.0])[:3])  # its determinant is 1
    refused("'image_size'", image_size=0)
    refused("pickled", codes=np.array([{}] * count, object))
    file.write_bytes(b"PK\3\4 nothing")
    with pytest.raises(DataError, match="not an octree"):
        read_octree(file)
    with pytest.raises(DataError, match="cannot read"):
        read_octree(tmp_path / "missing.octree")


def test_a_small_file_does_not_fill_the_memory(tmp_path: Path) -> None:
    file = tmp_path / "bomb.octree"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("colors.npy", bytes(200_000_000))
    with pytest.raises(DataError, match="claims to hold 200,000,000 bytes"):
        read_octree(file)


def test_a_truncated_file(tmp_path: Path) -> None:
    file = tmp_path / "x.octree"
    write_octree(file, ball())
    whole = file.read_bytes()
    for length in (0, 10, len(whole) // 2, len(whole) - 1):
        file.write_bytes(whole[:length])
        with pytest.raises(DataError):
            read_octree(file)


def test_raw_densities_have_the_depths_they_came_from() -> None:
    depths = torch.tensor([1e-3, 0.5, 3.0, 19.0, 21.0, 1e4])
    torch.testing.assert_close(depths_of(raw_of(depths)), depths, rtol=1e-4, atol=1e-7)

"""ns-export levels, and the commands that open its files."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch

import nerfloom
from nerfloom.blocks.composed import GaussianBlocks, Opened
from nerfloom.cameras.scale import Scale, write_scale
from nerfloom.cli import evaluate as eval_command
from nerfloom.cli import export as export_command
from nerfloom.data.offsets import write_offset
from nerfloom.export.run_levels import export_levels
from nerfloom.export.settings import LevelsSettings
from nerfloom.levels.drawn import DrawnLevels
from nerfloom.levels.files import read_levels
from nerfloom.splats.drawn import DrawnGaussians
from nerfloom.splats.files import write_gaussians
from nerfloom.splats.look import OURS, Look
from nerfloom.splats.transform import transformed
from nerfloom.training.loaded import Loaded
from tests.blocks.fakes import block, placement, scene
from tests.cli.helpers import called
from tests.conftest import Refused
from tests.levels.made import cloud, leaves
from tests.splats.test_alone import MIDDLE, ball, orbit

SMALL = ("--chunk-size", 64, "--build-memory", 1)


def exported(file: Path, *flags: object) -> Path:
    done = called("ns-export", "levels", file, "--output-dir", file.parent, *SMALL, *flags)
    assert done.returncode == 0, done.stderr
    return file.parent / "scene.levels"


@pytest.fixture(params=["ply", "spz"])
def splats(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    write_gaussians(tmp_path / f"x.{request.param}", ball())
    return tmp_path / f"x.{request.param}"


def psnr(evaluation: dict[str, Any]) -> float:
    return evaluation["results"]["psnr"]


def test_a_file_is_looked_at_as_its_gaussians_are(splats: Path) -> None:
    """Red above and blue below, with and without merged Gaussians."""
    levels = exported(splats)
    assert read_levels(levels).num_gaussians == 400
    assert len(read_levels(levels).nodes) == 15
    frames = orbit(levels, "fine", "--level-error", 0)
    assert (frames[:, 0] == 255).all()
    assert frames[:, 15, 25, 0].min() > 150 > 120 > frames[:, 15, 25, 2].max()
    assert frames[:, 40, 25, 2].min() > 150 > 120 > frames[:, 40, 25, 0].max()
    frames = orbit(levels, "coarse", "--level-error", 5, "--memory-limit", 1)
    assert (frames[:, 15, 25, 0] > frames[:, 15, 25, 2]).all()
    assert (frames[:, 38, 25, 2] > frames[:, 38, 25, 0]).all()
    turned = orbit(levels, "turned", "--up=-z")
    assert turned[:, 15, 25, 2].min() > 150 > 120 > turned[:, 15, 25, 0].max()


def test_a_file_is_judged_as_its_gaussians_are(shared_tiny: Path, tmp_path: Path) -> None:
    given = transformed(ball(), torch.eye(3), 0.25, -0.25 * MIDDLE)  # of radius 1 around the origin
    write_gaussians(tmp_path / "x.ply", given, look=Look(True))
    levels = exported(tmp_path / "x.ply")
    found, fine, coarse, limited = [], ("--level-error", 0), ("--level-error", 50), ("--memory-limit", 0.05)
    for file, flags in ((tmp_path / "x.ply", ()), *((levels, flags) for flags in (fine, limited, coarse))):
        done = called("ns-eval", file, "--data", shared_tiny, *flags)
        assert done.returncode == 0, done.stderr
        found.append(json.loads(file.with_suffix(".eval.json").read_text()))
    gaussians, fine, limited, coarse = found
    assert psnr(fine) == pytest.approx(psnr(gaussians), abs=1e-3)
    assert abs(psnr(coarse) - psnr(gaussians)) > 1e-3
    assert "max_level_error" not in gaussians["results"]
    for wanted, each in ((0, fine), (50, coarse)):
        assert [row["level_error"] for row in each["per_image"]] == [wanted] * 3
    needed = [row["level_error"] for row in limited["per_image"]]  # by the memory, instead of the 1 pixel asked for
    assert min(needed) >= 1
    assert limited["results"]["max_level_error"] == max(needed) > 1
    assert "400 Gaussians, 15 chunks" in done.stderr
    assert "antialiased" in done.stderr


def test_python_opens_and_writes_the_same(splats: Path) -> None:
    by_command = exported(splats)
    nerfloom.load(splats).export("levels", splats.parent / "python.levels", chunk_size=64, build_memory=1.0)
    one, other = read_levels(by_command), read_levels(splats.parent / "python.levels")
    for name in ("counts", "parents"):
        assert torch.equal(getattr(one.nodes, name), getattr(other.nodes, name))
    opened = nerfloom.load(by_command)
    assert isinstance(opened.model, DrawnLevels)
    plain = nerfloom.load(splats)
    torch.testing.assert_close(
        opened.placement.original_points(torch.zeros(1, 3)), plain.placement.original_points(torch.zeros(1, 3)),
        atol=1.5, rtol=0,
    )  # fmt: skip
    assert opened.placement.scale == pytest.approx(plain.placement.scale, rel=0.2)


def test_offsets_scales_regions_and_frames_are_kept(tmp_path: Path) -> None:
    file, survey = tmp_path / "x.ply", torch.tensor([500000.0, 5400000.0, 400.0], dtype=torch.float64)
    write_gaussians(file, ball(), look=Look(True, 0.1, "depth"))
    write_offset(file, survey)
    write_scale(file, Scale(0.5, "m"))
    top = ",".join(f"{value:.1f}" for value in (survey + MIDDLE.double() + torch.tensor([0.0, 0.0, 4.0])).tolist())
    levels = read_levels(exported(file, f"--crop-sphere={top},2.0", "--bits", 16))
    assert torch.equal(levels.origin, survey)
    assert (levels.look, levels.bits) == (Look(True, 0.1, "depth"), 16)
    distances = (ball().means - MIDDLE - torch.tensor([0.0, 0.0, 4.0])).norm(dim=-1)
    assert levels.num_gaussians == int((distances <= 2).sum()) > 5
    opened = nerfloom.load(levels.path)
    assert opened.scale == Scale(0.5, "m")
    middle = opened.placement.original_points(torch.zeros(1, 3))[0]
    assert float((middle - survey - MIDDLE.double() - torch.tensor([0.0, 0.0, 4.0])).norm()) < 2


def test_blocks_are_written_one_after_the_other(tmp_path: Path) -> None:
    """Two blocks have parts of one cloud, each in its own frame; the result is in the frame of the input."""
    whole, own = placement(0.5, (1.0, 2.0, 0.0)), (placement(2.0, angle=0.4), placement(3.0, (0.0, -4.0, 1.0)))
    models = [DrawnGaussians(transformed(cloud(500), *each.similarity()), OURS, scene()) for each in own]
    blocks = [block((-0.5, 0.0, 0.0), 4.0), block((0.5, 0.0, 0.0), 4.0)]
    model = GaussianBlocks(blocks, lambda number: Opened(models[number], own[number]), whole, scene())
    assert [len(part) for part in model.gaussian_parts()] == [
        int((cloud(500).means[:, 0] <= 0).sum()), int((cloud(500).means[:, 0] > 0).sum()),
    ]  # fmt: skip
    loaded = Loaded(model, whole, "gaussian-splatting", tmp_path / "blocks.yml", tmp_path / "blocks.yml")
    export_levels(loaded, tmp_path / "x.levels", LevelsSettings(chunk_size=64, build_memory=1.0))
    found = read_levels(tmp_path / "x.levels")
    means = torch.cat([found.read(index).means.double() + found.origin for index in leaves(found)])
    order, other = means[:, 0].argsort(), cloud(500).means[:, 0].argsort()
    torch.testing.assert_close(means[order], cloud(500).means[other].double(), rtol=0, atol=1e-4)


def test_what_does_not_fit_is_refused(tmp_path: Path, shared_tiny: Path, refused: Refused) -> None:
    file = tmp_path / "x.ply"
    write_gaussians(file, ball())
    levels, out = exported(file), ("--output-dir", tmp_path)
    assert refused(eval_command.main, levels).endswith("its photographs are unknown: give --data DIR")
    said = refused(eval_command.main, file, "--data", shared_tiny, "--level-error", 2)
    assert "--level-error has no effect" in said
    said = refused(eval_command.main, levels, "--data", shared_tiny, "--rays-per-pixel", 4)
    assert said == "error: --rays-per-pixel has no effect with levels of detail: leave it out"
    said = refused(eval_command.main, levels, "--data", shared_tiny, "--level-error=-1", status=2)
    assert "--level-error is -1" in said
    said = refused(eval_command.main, levels, "--data", shared_tiny, "--memory-limit", 0.001)
    assert "--memory-limit is 0.001 MB" in said
    assert "leave out --data" in refused(export_command.main, "levels", file, *out, "--data", shared_tiny)
    said = refused(export_command.main, "levels", file, *out, "--level-error", 2)
    assert said == "error: --level-error has no effect with a file of Gaussians: leave it out"
    assert "--chunk-size is 3" in refused(export_command.main, "levels", file, *out, "--chunk-size", 3, status=2)
    assert "--build-memory" in refused(export_command.main, "levels", file, *out, "--build-memory", 1, status=2)
    assert "has no Gaussians" in refused(export_command.main, "gaussian-splat", levels, *out)
    assert "photographs of this run have no times" in refused(export_command.main, "levels", file, *out, "--time", 0.5)
    said = refused(export_command.main, "levels", file, *out, *SMALL, "--crop-sphere=99,0,0,1")
    assert "no Gaussians" in said
    content = bytearray(levels.read_bytes())
    content[-5] ^= 1
    levels.write_bytes(content)
    said = refused(eval_command.main, levels, "--data", shared_tiny)
    assert f"{levels} is not a file of levels, or is damaged" in said

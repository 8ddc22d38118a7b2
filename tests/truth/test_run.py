"""A capture with a known truth, trained on, judged and exported by the commands: every number against the truth."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from skimage.metrics import structural_similarity

from nerfloom.evaluation import panels
from tests.cli.helpers import called
from tests.truth.ball import CENTRE, COUNT, HEIGHT, HELD_OUT, NAMES, RADIUS, WAVES, WIDTH, photograph, pose_of
from tests.truth.formats import BENT, write_nerfstudio

TINY = (
    "--num-levels", 6, "--max-resolution", 64, "--log2-table-size", 13, "--num-proposal-samples", 48, 24,
    "--num-nerf-samples", 12, "--num-rays-per-batch", 512, "--predict-normals", "True", "--max-num-iterations", 120,
    "--max-eval-images", 0, "--vis", "none",
)  # fmt: skip


def command(name: str, *words: object) -> None:
    """Run it in this process."""
    done = called(name, *words)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Through a lens that bends, in a frame and unit that are not the capture's own, with depth."""
    return write_nerfstudio(tmp_path_factory.mktemp("data") / "ball", BENT)


@pytest.fixture(scope="module")
def trained(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of nerfacto."""
    output = tmp_path_factory.mktemp("out")
    command("ns-train", "nerfacto", "--data", capture, "--output-dir", output, "--timestamp", "t", *TINY)
    return output / "ball" / "nerfacto" / "t"


def read_cloud(file: Path) -> np.ndarray:
    """A PLY file's vertices as a structured array, by its header."""
    header, body = file.read_bytes().split(b"end_header\n", 1)
    kinds = {"float": "<f4", "uchar": "u1"}
    rows = [line.split() for line in header.decode().splitlines() if line.startswith("property")]
    return np.frombuffer(body, [(name, kinds[kind]) for _, kind, name in rows])


@pytest.mark.medium
def test_points_lie_on_the_ball_with_its_normals_and_colours(trained: Path, tmp_path: Path) -> None:
    """They are in the capture's own frame and unit, which are neither the file's nor the scene's."""
    command(
        "ns-export", "pointcloud", "--load-config", trained / "config.yml", "--output-dir", tmp_path,
        "--num-points", 20_000,
    )  # fmt: skip
    cloud = read_cloud(tmp_path / "point_cloud.ply")
    points = np.stack([cloud[axis] for axis in "xyz"], -1).astype(float)
    normals = np.stack([cloud[f"n{axis}"] for axis in "xyz"], -1).astype(float)
    colors = np.stack([cloud[name] for name in ("red", "green", "blue")], -1) / 255
    away = points - CENTRE
    distances = np.linalg.norm(away, axis=-1)
    true_normals = away / distances[:, None]
    cosines = (normals * true_normals).sum(-1)
    true_colors = 0.5 + 0.45 * np.sin(RADIUS * true_normals @ WAVES.T)
    off = np.abs(colors - true_colors).mean(-1)
    print(
        f"{len(points)} points, {np.median(np.abs(distances - RADIUS)):.3f} m off at the median, normals' cosine "
        f"{np.median(cosines):.3f}, colours {np.median(off):.3f}"
    )
    assert len(points) > 3_000
    assert np.median(np.abs(distances - RADIUS)) < 0.03
    assert np.linalg.norm(np.median(points, 0) - CENTRE) < 0.1
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-3)
    assert np.median(cosines) > 0.97
    assert np.median(off) < 0.2  # 0.36 with two channels exchanged


def test_cameras_are_the_captures(trained: Path, tmp_path: Path) -> None:
    command("ns-export", "cameras", "--load-config", trained / "config.yml", "--output-dir", tmp_path)
    listed = json.loads((tmp_path / "transforms_train.json").read_text())
    assert [row["file_path"] for row in listed] == [name for name in NAMES if name not in HELD_OUT]
    for row in listed:
        truth = pose_of(NAMES.index(row["file_path"]))[:3]
        np.testing.assert_allclose(np.array(row["transform"]), truth, atol=2e-6)


def test_other_programs_find_the_scene_by_the_transform_beside_it(trained: Path) -> None:
    """nerfstudio's file: `scale * (transform @ x)` of the capture's own frame; all cameras fit [-1, 1] there."""
    content = json.loads((trained / "dataparser_transforms.json").read_text())
    transform = np.array(content["transform"])
    positions = np.stack([pose_of(index)[:3, 3] for index in range(COUNT)])
    placed = content["scale"] * (positions @ transform[:, :3].T + transform[:, 3])
    assert np.abs(placed).max() == pytest.approx(1, abs=1e-5)
    np.testing.assert_allclose(placed.mean(0), 0, atol=1e-5)
    ups = np.stack([pose_of(index)[:3, 1] for index in range(COUNT)]).mean(0)
    turned = Rotation.from_matrix(transform[:, :3]).apply(ups / np.linalg.norm(ups))
    np.testing.assert_allclose(turned, [0, 0, 1], atol=1e-5)


def evaluated(trained: Path, folder: Path, *flags: object) -> dict[str, Any]:
    file = folder / "eval.json"
    command(
        "ns-eval", "--load-config", trained / "config.yml", "--output-path", file, "--render-output-path",
        folder / "pictures", "--round-to-uint8", "True", *flags,
    )  # fmt: skip
    content: dict[str, Any] = json.loads(file.read_text())
    return content


def parts(comparison: np.ndarray) -> list[np.ndarray]:
    """The first three parts of a comparison, without the frames around them, one pixel where it shows a square."""
    factor = -(-panels.MIN_WIDTH // WIDTH)
    gap = max(factor * WIDTH // panels.TEXT_SHARE, panels.MIN_TEXT)
    top, step = round(1.6 * gap) + factor // 2, factor * WIDTH + gap
    lefts = [gap + index * step + factor // 2 for index in range(3)]
    return [comparison[top:, left:][: factor * HEIGHT : factor, : factor * WIDTH : factor] for left in lefts]


def test_figures_are_those_of_the_pictures_and_of_the_photographs_held_out(trained: Path, tmp_path: Path) -> None:
    found = evaluated(trained, tmp_path)
    assert [row["name"] for row in found["per_image"]] == HELD_OUT
    figures = []
    for place, (name, row) in enumerate(zip(HELD_OUT, found["per_image"], strict=True)):
        stem = f"{place:04d}_{Path(name).stem}"
        render = np.asarray(Image.open(tmp_path / "pictures" / f"{stem}.png"), float) / 255
        rgba = photograph(NAMES.index(name), BENT) / 255
        truth = rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:])
        error = ((render - truth) ** 2).mean()
        similarity = structural_similarity(
            render, truth, channel_axis=-1, data_range=1, gaussian_weights=True, sigma=1.5,
            use_sample_covariance=False, full=True,
        )[1][5:-5, 5:-5].mean()  # fmt: skip
        assert row["psnr"] == pytest.approx(-10 * np.log10(error), abs=1e-3)
        assert row["ssim"] == pytest.approx(similarity, abs=1e-4)
        figures.append((row["psnr"], row["ssim"]))
        written = np.asarray(Image.open(tmp_path / "pictures" / f"{stem}_photograph.png"), float) / 255
        np.testing.assert_allclose(written, truth, atol=0.51 / 255)
        three = parts(np.asarray(Image.open(tmp_path / "pictures" / f"{stem}_comparison.png"), float) / 255)
        np.testing.assert_allclose(three[0], truth, atol=0.51 / 255)
        np.testing.assert_allclose(three[1], render, atol=1e-9)
        shown = np.clip(3 * np.abs(render - truth).mean(-1) / 0.25, 0, 1)
        np.testing.assert_allclose(three[2][..., 0], shown, atol=2 / 255)
        facing = np.asarray(Image.open(tmp_path / "pictures" / f"{stem}_normals.png"), float) / 255 * 2 - 1
        assert facing.shape == (HEIGHT, WIDTH, 3)
    results = found["results"]
    assert (results["psnr"], results["ssim"]) == pytest.approx(tuple(np.mean(figures, 0)))
    assert results["psnr"] > 15
    assert results["num_rays_per_sec"] == pytest.approx(results["fps"] * WIDTH * HEIGHT)
    seconds = [row["seconds"] for row in found["per_image"]]
    assert results["fps"] == pytest.approx(len(seconds) / sum(seconds))


def test_views_that_are_learnt_from_are_judged_only_where_asked_for(trained: Path, tmp_path: Path) -> None:
    found = evaluated(trained, tmp_path, "--split", "train", "--max-images", 3)
    rest = [name for name in NAMES if name not in HELD_OUT]
    assert [row["name"] for row in found["per_image"]] == [rest[0], rest[3], rest[6]]

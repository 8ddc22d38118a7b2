"""Depth images: reading, distances along rays, and that they teach where light comes from."""

import dataclasses
import tracemalloc
from contextlib import suppress
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from PIL import Image

from nerfloom.base.errors import DataError
from nerfloom.cameras.cameras import Cameras
from nerfloom.data.dataset import load_dataset
from nerfloom.data.depths import ray_distances, read_depth, read_depths
from nerfloom.data.pixels.batch import gather_batch
from nerfloom.geometry.rays import Samples
from nerfloom.losses.functions import depth_error
from tests.training.helpers import tiny_run


def test_millimetres_in_sixteen_bits(tmp_path: Path) -> None:
    steps = np.array([[0, 1500, 3000], [40000, 65535, 7]], np.uint16)
    iio.imwrite(tmp_path / "d.png", steps)
    assert read_depth(tmp_path / "d.png", 3, 2).tolist() == steps.astype(float).tolist()


def test_a_smaller_depth_image_gives_its_nearest_value(tmp_path: Path) -> None:
    np.save(tmp_path / "d.npy", np.array([[1.0, 2.0], [3.0, 4.0]], np.float32))
    found = read_depth(tmp_path / "d.npy", 5, 4)
    assert found.shape == (4, 5)
    assert set(found.reshape(-1).tolist()) == {1.0, 2.0, 3.0, 4.0}
    assert found[0, 0] == 1
    assert found[3, 4] == 4


def test_of_an_animation_the_first_picture_is_read(tmp_path: Path) -> None:
    """All of them together may take any memory."""
    steps = [np.full((2, 3), value, np.uint8) for value in (7, 9)]
    first, second = map(Image.fromarray, steps)
    first.save(tmp_path / "d.png", save_all=True, append_images=[second])
    with Image.open(tmp_path / "d.png") as written:
        assert written.n_frames == 2
    assert read_depth(tmp_path / "d.png", 3, 2).tolist() == steps[0].tolist()


def test_a_picture_far_larger_than_its_photograph_is_refused_by_its_head(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    iio.imwrite(tmp_path / "d.png", np.zeros((33, 32), np.uint16))
    assert read_depth(tmp_path / "d.png", 4, 5).shape == (5, 4)
    monkeypatch.setattr("nerfloom.data.depths._values", lambda path: pytest.fail("its pixels were read"))
    with pytest.raises(DataError, match=r"d\.png has 32 x 33 pixels, its image 4 x 4; the limit is 64 times"):
        read_depth(tmp_path / "d.png", 4, 4)


def test_a_chunk_takes_no_more_memory_than_its_file_has(tmp_path: Path) -> None:
    """Its length is a claim of up to 4 GB, and whoever believes it asks for as much."""
    iio.imwrite(tmp_path / "d.png", np.full((15, 20), 1500, np.uint16))
    content = bytearray((tmp_path / "d.png").read_bytes())
    at = content.index(b"IDAT")
    content[at - 4 : at] = (2**31 - 1).to_bytes(4, "big")
    (tmp_path / "d.png").write_bytes(content)
    tracemalloc.start()
    try:
        with suppress(DataError):
            read_depth(tmp_path / "d.png", 20, 15)
        assert tracemalloc.get_traced_memory()[1] < 2**24
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("content", ["missing", "text", "colour", "pickle"])
def test_what_is_no_depth_image_is_named(content: str, tmp_path: Path) -> None:
    path = tmp_path / "d.npy"
    if content == "text":
        path.write_text("no")
    elif content == "colour":
        np.save(path, np.zeros((2, 2, 3)))
    elif content == "pickle":
        np.save(path, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(DataError, match=r"d\.npy"):
        read_depth(path, 2, 2)


@pytest.mark.parametrize("endless", [np.inf, 2e5])  # float16 ends at 65504
def test_unknown_depths_are_zero(tmp_path: Path, endless: float) -> None:
    np.save(tmp_path / "d.npy", np.array([[np.nan, endless], [-1.0, 2.0]], np.float32))
    sizes = torch.tensor([2, 2])
    ones = torch.ones(2)
    cameras = Cameras(torch.eye(4)[:3].expand(2, 3, 4), ones, ones, ones, ones, sizes, sizes)
    assert read_depths([tmp_path / "d.npy", None], cameras, 0.5).tolist() == [0, 0, 0, 1, 0, 0, 0, 0]


def test_a_wall_straight_ahead_is_further_along_slanted_rays() -> None:
    angles = torch.tensor([0.0, 0.3, 1.0])
    directions = torch.stack([angles.sin(), torch.zeros(3), -angles.cos()], dim=-1)
    poses = torch.eye(4)[:3].expand(3, 3, 4)
    found = ray_distances(torch.tensor([2.0, 2.0, 0.0]), directions, poses)
    torch.testing.assert_close(found, torch.tensor([2.0, 2.0 / float(angles[1].cos()), 0.0]))


def test_depth_error_in_closed_form() -> None:
    """Half of a ray's light from the right distance, half from 1.5 times it; a ray of unknown distance counts not."""
    samples = Samples.regular(torch.tensor([[1.9, 2.9], [0.0, 1.0]]), torch.tensor([[2.1, 3.1], [1.0, 2.0]]))
    weights = torch.full((4,), 0.5, requires_grad=True)
    loss = depth_error(weights, samples, torch.tensor([2.0, 0.0]))
    torch.testing.assert_close(loss, torch.tensor(0.25))
    (grad,) = torch.autograd.grad(loss, weights)
    torch.testing.assert_close(grad, torch.tensor([0.0, 0.5, 0.0, 0.0]))
    assert depth_error(weights, samples, torch.zeros(2)) == 0


def ball_depths(folder: Path, parsed) -> tuple[Path, ...]:
    """Exact depths of the tiny data set's ball, in thousandths."""
    paths = []
    for index in range(len(parsed.cameras)):
        rays = parsed.cameras.pixel_rays(parsed.cameras.image_pixels(index), 0.0, 10.0)
        nearest = -(rays.origins * rays.directions).sum(-1)
        inside = 1 - (rays.origins.square().sum(-1) - nearest**2)
        distance = nearest - inside.clamp(min=0).sqrt()
        axis = -parsed.cameras.camera_to_worlds[index, :, 2]
        depth = torch.where(inside > 0, distance * (rays.directions @ axis), torch.zeros_like(distance))
        size = int(parsed.cameras.heights[index])
        paths.append(folder / f"{index}.png")
        iio.imwrite(paths[-1], (1000 * depth).round().numpy().astype(np.uint16).reshape(size, -1))
    return tuple(paths)


@pytest.mark.parametrize("places", [1, 4])
def test_depths_reach_batches_as_distances(places: int, shared_tiny: Path, tmp_path: Path) -> None:
    from nerfloom.cameras.cameras import subpixels

    run = tiny_run("nerfacto", shared_tiny, tmp_path)
    parsed = run.parser.parse(shared_tiny, "train")
    parsed = dataclasses.replace(parsed, depth_paths=ball_depths(tmp_path, parsed))
    dataset = load_dataset(parsed, "train")
    assert dataset.scene.has_depth
    flat = dataset.cameras.image_pixels(3)
    batch = gather_batch(dataset, flat, torch.ones(len(flat), 3), subpixels(places))
    assert batch.distances is not None
    hit = batch.distances > 0
    assert 0.1 < hit.float().mean() < 0.9
    centre = dataset.cameras.pixel_rays(flat, 0.0, 10.0)
    points = centre.origins + batch.distances[:, None] * centre.directions
    assert (points[hit].norm(dim=-1) - 1).abs().max() < 0.01


@pytest.mark.medium
def test_depth_teaches_nerfacto_where_the_surface_is(shared_tiny: Path, tmp_path: Path) -> None:
    parsed = tiny_run("nerfacto", shared_tiny, tmp_path / "still").parse("train")
    parsed = dataclasses.replace(parsed, depth_paths=ball_depths(tmp_path, parsed))
    from nerfloom.training.trainer import Trainer

    errors = []
    for mult in (0.0, "auto"):
        folder = tmp_path / f"run{mult}"
        folder.mkdir()
        run = tiny_run("nerfacto", shared_tiny, folder, max_num_iterations=120, max_eval_images=0, depth_loss_mult=mult)
        dataset = load_dataset(parsed, "train")
        trainer = Trainer.of(run, dataset)
        trainer.train()
        batch = gather_batch(dataset, dataset.cameras.image_pixels(0), torch.ones(400, 3))
        with torch.no_grad():
            rendered = trainer.model.eval().render(batch.rays, batch.background)
        assert batch.distances is not None
        hit = batch.distances > 0
        errors.append((rendered.median_depth - batch.distances)[hit].abs().median().item())
    print("median depth error without and with depth images:", errors)
    assert errors[1] < 0.2
    assert errors[1] < 0.7 * errors[0]

"""Every reader of files that come from elsewhere, each with a small input that it takes."""

import json
import math
import os
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import is_dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import torch

from nerfloom import DataParser, Dataset
from nerfloom.base.plain import from_plain, read_yaml
from nerfloom.blocks.block import TrainedBlock
from nerfloom.blocks.files import BlockList, read_blocks, write_blocks
from nerfloom.blocks.visibility import Visibility, read_visibility, write_visibility
from nerfloom.cameras.camera_path import MAX_FRAMES, CameraPath, Keyframe, read_camera_path, write_camera_path
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.scale import Scale, read_scale, write_scale
from nerfloom.cli.compare import CompareFlags, plan_of
from nerfloom.data.dataset import load_dataset
from nerfloom.data.depths import read_depth
from nerfloom.data.diffuse_light import read_diffuse
from nerfloom.data.normals import read_normals
from nerfloom.data.pixels.cache import PixelMemory, pack, unpack
from nerfloom.data.pixels.memory_mapped import MappedPixels
from nerfloom.data.ply import read_points
from nerfloom.dataparsers.blender import Blender
from nerfloom.dataparsers.colmap import Colmap
from nerfloom.dataparsers.dnerf import DNeRF
from nerfloom.dataparsers.dtu import Dtu
from nerfloom.dataparsers.llff import Llff
from nerfloom.dataparsers.nerfstudio import Nerfstudio
from nerfloom.dataparsers.phototourism import Phototourism
from nerfloom.dataparsers.polycam import Polycam
from nerfloom.dataparsers.record3d import Record3D
from nerfloom.dataparsers.sdfstudio import SdfStudio
from nerfloom.downloads import unpack as downloads
from nerfloom.edit.recipe import STEPS, step_of
from nerfloom.edit.recipe import read_recipe as read_steps
from nerfloom.edit.recipe import write_recipe as write_steps
from nerfloom.evaluation.lpips import SHAPES, read_weights
from nerfloom.evaluation.surface_files import read_mesh
from nerfloom.evaluation.surface_files import read_points as read_surface_points
from nerfloom.evaluation.surfaces import drawn
from nerfloom.export.mesh import Mesh
from nerfloom.export.mesh_files import write_mesh
from nerfloom.geometry.rays import Rays
from nerfloom.geometry.regions import Box, Polygon, Sphere, read_regions, write_regions
from nerfloom.levels.files import read_levels
from nerfloom.octrees.drawn import DrawnOctree
from nerfloom.octrees.files import read_octree, write_octree
from nerfloom.processing import aria, bundler, metashape, opensfm, realitycapture
from nerfloom.processing.capture import Capture
from nerfloom.processing.images import prepare_all
from nerfloom.processing.kinds import process
from nerfloom.processing.listing import find_images
from nerfloom.processing.named_images import placed_images
from nerfloom.processing.posed_folder import write_capture as write_placed
from nerfloom.processing.settings import PolycamFlags, Record3DFlags
from nerfloom.processing.views import Views
from nerfloom.splats.files import read_gaussians, write_gaussians
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import MAX_BLUR, MIN_BLUR, Look
from nerfloom.training.checkpoint import FOLDER, load_checkpoint, load_newest
from nerfloom.training.datasets import load_split
from nerfloom.training.run import Run, create_folder, read_run
from nerfloom.training.trained import load_trained
from nerfloom.training.trainer import Trainer
from tests.conftest import write_tiny
from tests.dataparsers.captures import write_capture
from tests.dataparsers.captures import write_images as write_pictures
from tests.dataparsers.sparse_models import make_capture, write_colmap, write_images
from tests.dataparsers.test_dtu import write_dtu
from tests.dataparsers.test_llff import poses_bounds
from tests.dataparsers.test_polycam import write_polycam
from tests.dataparsers.test_record3d import write_record3d
from tests.dataparsers.test_sdfstudio import write_sdfstudio
from tests.exr_files import NONE, RLE, ZIP, ZIPS, write_exr
from tests.fuzz.reader import Reader, require
from tests.fuzz.sense import check_cameras, check_dataset, check_scene
from tests.images import noise
from tests.levels.made import built, cloud
from tests.octrees.balls import ball
from tests.processing.programs import write_bundler, write_metashape, write_odm, write_realitycapture
from tests.processing.test_aria import write_recording
from tests.splats.foreign_files import write_compressed, write_ksplat, write_splat
from tests.training.helpers import tiny_run

MEMORY = 20e6
"""Bytes of pixels that may be held in memory; small inputs stay far below."""
COUNT = 5
"""Photographs of a capture."""
SDFSTUDIO = (
    "camera_model", "height", "width", "worldtogt", "scene_box", "aabb", "rgb_path", "camtoworld", "intrinsics",
    "foreground_mask", "mask_path", "sensor_depth_path", "frames",
)  # fmt: skip
CAPTURE = (
    "k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "camera_model", "is_fisheye", "fl_x", "fl_y", "cx", "cy", "w", "h",
    "camera_angle_x", "camera_angle_y", "file_path", "transform_matrix", "mask_path", "depth_file_path", "time",
    "ply_file_path", "aabb_scale", "scale", "offset", "applied_scale", "applied_transform", "train_filenames",
    "val_filenames", "test_filenames", "frames",
)  # fmt: skip


def edit(file: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


# -- formats ------------------------------------------------------------------------------------------------------


def parse(parser: DataParser, folder: Path, scratch: Path) -> None:
    """Recognise, which must never fail, and parse."""
    type(parser).recognizes(folder)
    check_scene(parser.parse(folder, "train"))


def write_blender(folder: Path) -> None:
    write_tiny(folder, size=8, counts=(4, 1, 1))


def write_dnerf(folder: Path) -> None:
    write_blender(folder)
    edit(folder / "transforms_train.json", lambda c: [frame.update(time=i / 3) for i, frame in enumerate(c["frames"])])


def write_nerfstudio(folder: Path) -> None:
    """Write a data set with all parts that the format may have."""
    applied = [[1, 0, 0, 0.5], [0, -1, 0, 0.25], [0, 0, -1, 2.0]]
    placed = {"applied_transform": applied, "applied_scale": 2.0, "aabb_scale": 4}
    write_capture(folder, COUNT, camera_model="OPENCV", k1=0.01, ply_file_path="points.ply", **placed)
    head = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    (folder / "points.ply").write_text(f"{head}end_header\n0.3 -0.2 0.5\n-0.4 0.1 0.9\n0 0.5 0.2\n")
    write_pictures(folder / "masks", ["000.png"])
    write_pictures(folder / "depths", ["001.png"])
    edit(folder / "transforms.json", lambda c: c["frames"][0].update(mask_path="masks/000.png", time=0.0))
    edit(folder / "transforms.json", lambda c: c["frames"][1].update(depth_file_path="depths/001.png"))
    edit(folder / "transforms.json", lambda c: [frame.update(time=i / COUNT) for i, frame in enumerate(c["frames"])])


def write_sparse(folder: Path, binary: bool) -> None:
    import pycolmap

    capture = make_capture(COUNT)
    write_images(folder / "images", capture.names)
    model = write_colmap(folder / "sparse" / "0", capture, "OPENCV 60 40 50 48 31 19 0.1 -0.02 0.003 -0.001")
    if binary:
        pycolmap.Reconstruction(os.fspath(model)).write_binary(os.fspath(model))
        for file in model.glob("*.txt"):
            file.unlink()


def write_phototourism(folder: Path) -> None:
    capture = make_capture(COUNT)
    write_images(folder / "dense" / "images", capture.names)
    write_colmap(folder / "dense" / "sparse", capture)
    rows = [f"{name}\t{index}.0\t{'test' if index == 4 else 'train'}\tgate" for index, name in enumerate(capture.names)]
    (folder / "gate.tsv").write_text("\n".join(["filename\tid\tsplit\tdataset", *rows]) + "\n")


def write_llff(folder: Path) -> None:
    capture = make_capture(COUNT, spread=0.15)
    write_images(folder / "images", capture.names)
    np.save(folder / "poses_bounds.npy", poses_bounds(capture))


def write_ply(folder: Path) -> None:
    kinds = {"ascii": "", "binary_little_endian": "<f4", "binary_big_endian": ">f4"}
    points = np.random.default_rng(0).normal(size=(6, 3))
    for name, kind in kinds.items():
        head = f"ply\nformat {name} 1.0\ncomment none\nelement vertex 6\n"
        head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
        body = points.astype(kind).tobytes() if kind else "\n".join(" ".join(map(str, row)) for row in points).encode()
        (folder / f"{name}.ply").write_bytes(head.encode() + body)


def read_ply(folder: Path, scratch: Path) -> None:
    for file in sorted(folder.glob("*.ply")):
        points = read_points(file)
        require(points.shape[1:] == (3,) and bool(points.isfinite().all()), "points that are nowhere")


def write_surfaces(folder: Path) -> None:
    positions = torch.eye(4, dtype=torch.float64)[:, :3]
    faces, normals = torch.tensor([[0, 1, 2], [0, 2, 3]]), torch.nn.functional.normalize(positions + 0.1, dim=-1)
    for suffix in ("ply", "obj", "glb"):
        write_mesh(folder / f"mesh.{suffix}", Mesh(positions, faces, normals))


def read_surfaces(folder: Path, scratch: Path) -> None:
    for file in sorted(folder.glob("mesh.*")):
        found = [read_mesh(file)] + ([read_surface_points(file)] if file.suffix == ".ply" else [])
        for surface in found:
            require(0 < surface.side < math.inf, "a surface without extent")
            places = drawn(surface, 100)
            require(bool(places.positions.isfinite().all()), "points that are nowhere")
            require(places.normals is None or bool(places.normals.isfinite().all()), "normals that point nowhere")


def write_splats(folder: Path) -> None:
    random = torch.Generator().manual_seed(0)
    shapes = ((6, 3), (6, 3), (6, 4), (6,), (6, 3), (6, 3, 8))
    gaussians = Gaussians(*(torch.randn(shape, generator=random) for shape in shapes))
    (folder / "sog").mkdir()
    for name in ("splat.ply", "splat.spz", "splat.sog", "sog/meta.json"):
        write_gaussians(folder / name, gaussians, look=Look(True, 0.1))
    write_gaussians(folder / "splat3.spz", gaussians, look=Look(True, 0.1), spz_version=3)
    write_gaussians(folder / "splat4.spz", gaussians, look=Look(True, 0.1), spz_version=4)
    write_splat(folder / "splat.splat", gaussians)
    write_compressed(folder / "splat.compressed.ply", gaussians)
    for level in range(3):
        write_ksplat(folder / f"splat{level}.ksplat", gaussians, level)


def read_splats(folder: Path, scratch: Path) -> None:
    for file in [*sorted(folder.glob("splat*")), folder / "sog" / "meta.json"]:
        gaussians, look = read_gaussians(file)
        require(MIN_BLUR <= look.blur <= MAX_BLUR, "Gaussians that are drawn as none can be")
        require(len(gaussians), "no Gaussians")
        require(bool(gaussians.finite().all()), "Gaussians that are nowhere")
        require(bool(gaussians.log_scales.exp().isfinite().all()), "Gaussians without end")
        require(bool((gaussians.rotations.norm(dim=-1) > 0).all()), "Gaussians without axes")


def write_octrees(folder: Path) -> None:
    for degree in (0, 1):
        write_octree(folder / f"{degree}.octree", ball(degree))


def read_octrees(folder: Path, scratch: Path) -> None:
    for file in sorted(folder.glob("*.octree")):
        octree = read_octree(file)
        require(octree.layout.num_leaves == len(octree.leaves.codes), "leaves without values")
        require(bool(octree.leaves.coefficients().isfinite().all()), "colours that are not finite")
        require(bool(octree.scene.box.isfinite().all()), "a box that is nowhere")
        count = 50
        directions = torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)
        rays = Rays(torch.randn(count, 3), directions, fars=torch.full((count,), 100.0))
        for some in (rays, replace(rays, pixel_radii=torch.rand(count))):  # the second need coarser levels
            light = DrawnOctree(octree, octree.scene).light(some, torch.ones(3), 0.0)
            require(bool(light.opacity.isfinite().all()), "light that is not finite")


def write_levels(folder: Path) -> None:
    for bits in (16, 32):
        built(folder / f"{bits}.levels", cloud(40), 16, bits)  # type: ignore[arg-type]


def read_some_levels(folder: Path, scratch: Path) -> None:
    for file in sorted(folder.glob("*.levels")):
        levels = read_levels(file)
        nodes = levels.nodes
        require(bool((nodes.counts > 0).all()), "chunks without Gaussians")
        require(bool((nodes.low <= nodes.high).all() and nodes.high.isfinite().all()), "boxes that are nowhere")
        require(bool(levels.origin.isfinite().all()), "an origin that is nowhere")
        require(MIN_BLUR <= levels.look.blur <= MAX_BLUR, "Gaussians that are drawn as none can be")
        for index in range(len(nodes)):
            require(len(levels.read(index)) == int(nodes.counts[index]), "a chunk of another size")


def write_path(folder: Path) -> None:
    """A camera path with all that the format may have."""
    poses = torch.eye(4, dtype=torch.float64)[:3].repeat(3, 1, 1)
    fovs, times = torch.tensor([50.0, 60.0, 70.0], dtype=torch.float64), torch.tensor([0.0, 0.5, 1.0])
    keyframes = (Keyframe(poses[0], 50.0, 0.0, 1.0), Keyframe(poses[2], 70.0))
    placement = Placement(poses[0], 0.5)
    path = CameraPath("perspective", 40, 30, poses, fovs, 1.0, times, keyframes=keyframes, placement=placement)
    write_camera_path(folder / "camera_path.json", path)


def read_path(folder: Path, scratch: Path) -> None:
    path = read_camera_path(folder / "camera_path.json")
    require(1 <= len(path) <= MAX_FRAMES and 0 < path.fps < math.inf, "a video of no length")
    other = Placement(torch.eye(4, dtype=torch.float64)[:3], 2.0)
    for cameras in (path.cameras(), path.placed(other).cameras()):
        check_cameras(cameras, 0.1, 10.0)
    require(path.times is None or bool(((path.times >= 0) & (path.times <= 1)).all()), "times out of range")
    for keyframe in path.keyframes:
        require(bool(keyframe.pose.isfinite().all()) and 0 < keyframe.fov < math.inf, "a keyframe that is nowhere")


# -- images -------------------------------------------------------------------------------------------------------


def load(parser: DataParser, limit: float, folder: Path, scratch: Path) -> None:
    """Parse and decode, into memory, or into a file where the limit is below the set's size."""
    memory = PixelMemory(limit, scratch / "cache")
    check_dataset(load_dataset(parser.parse(folder, "train"), "train", memory, masks="auto"))


def write_masked(folder: Path) -> None:
    """Photographs, each with a mask of its own and a depth image."""
    write_capture(folder, COUNT)
    (folder / "masks").mkdir()
    (folder / "depths").mkdir()
    content = json.loads((folder / "transforms.json").read_text())
    for index, frame in enumerate(content["frames"]):
        frame["mask_path"] = f"masks/{index}.png"
        frame["depth_file_path"] = f"depths/{index}.{'png' if index % 2 else 'npy'}"
        iio.imwrite(folder / frame["mask_path"], np.where(noise(40, 30, index)[..., 0] > 100, 255, 0).astype(np.uint8))
        depth = 100 * noise(20, 15, index)[..., 0].astype(np.uint16)
        if index % 2:
            iio.imwrite(folder / frame["depth_file_path"], depth)
        else:
            np.save(folder / frame["depth_file_path"], depth.astype(np.float32))
    (folder / "transforms.json").write_text(json.dumps(content))


def write_photographs(folder: Path) -> None:
    for index, name in enumerate(("a b.png", "sub/c.png", "sub/d.JPG", "e.jpg")):
        (folder / name).parent.mkdir(exist_ok=True)
        iio.imwrite(folder / name, noise(20, 16, index), extension=Path(name).suffix.lower())


def read_photographs(folder: Path, scratch: Path) -> None:
    sources = find_images(folder)
    photographs, unreadable = prepare_all(folder, sources, scratch / "images")
    require(len(photographs) + len(unreadable) == len(sources), "a photograph that nobody speaks of")
    for photograph in photographs:
        require((scratch / "images" / photograph.name).is_file(), f"{photograph.name}, which is not there")


# -- phones -------------------------------------------------------------------------------------------------------


def convert_polycam(folder: Path, scratch: Path) -> None:
    output = scratch / "data"
    process("polycam", PolycamFlags(data=folder, output_dir=output, overwrite=True, crop_border_pixels=3))
    parse(Nerfstudio(), scratch / "data", scratch)


def write_record3d_whole(folder: Path) -> None:
    """Images of the size that the recording says."""
    write_record3d(folder)
    edit(folder / "EXR_RGBD" / "metadata.json", lambda c: c.update(w=20, h=15, K=[*(k / 2 for k in c["K"][:8]), 1]))


def convert_record3d(folder: Path, scratch: Path) -> None:
    process("record3d", Record3DFlags(data=folder, output_dir=scratch / "data", overwrite=True))
    parse(Nerfstudio(), scratch / "data", scratch)


# -- other programs -----------------------------------------------------------------------------------------------


def convert(read: Callable[[Path], Capture], images: str, folder: Path, scratch: Path) -> None:
    """Write and parse the data folder of a capture that another program placed."""
    capture = read(folder)
    placed = placed_images(folder / images, capture)
    require(capture.total >= len(placed.cameras), "more images than cameras")
    (scratch / "data").mkdir()
    write_placed(folder / images, capture, placed, scratch / "data", 0, Views(4, 90.0), whole=False)
    parse(Nerfstudio(), scratch / "data", scratch)


def read_metashape(folder: Path) -> Capture:
    return metashape.read_capture(folder / "cameras.xml")


def read_realitycapture(folder: Path) -> Capture:
    return realitycapture.read_capture(folder / "cameras.csv")


def read_odm(folder: Path) -> Capture:
    return opensfm.read_capture(opensfm.find_reconstruction(folder))


def read_bundler(folder: Path) -> Capture:
    return bundler.read_capture(folder / "bundle.out", folder / "list.txt")


def read_aria(folder: Path) -> Capture:
    return aria.read_capture(folder / "images", folder / "mps", 300)


OPENSFM = (
    "projection_type", "width", "focal", "focal_x", "c_x", "k1", "rotation", "translation", "camera", "shots",
    "coordinates",
)  # fmt: skip


# -- runs ---------------------------------------------------------------------------------------------------------


SMALL = {"log2_table_size": 8, "num_levels": 2}


def without_place(folder: Path) -> None:
    """A config.yml that says the same wherever it was made, so that a seed damages it in the same way."""
    file = folder / "config.yml"
    lines = file.read_text().splitlines()
    file.write_text("\n".join("data: photographs" if line.startswith("data: ") else line for line in lines) + "\n")


def write_run(folder: Path) -> None:
    """A run with two checkpoints."""
    data = write_tiny(folder / "data", size=8, counts=(4, 1, 1))
    run = tiny_run("instant-ngp", data, folder / "run", **SMALL)
    create_folder(run)
    without_place(run.folder)
    trainer = Trainer.of(run, load_split(run, "train"))
    trainer.config = replace(trainer.config, data=Path("photographs"))
    for _ in range(2):
        trainer.train_step()
        trainer.save()
    shutil.rmtree(data)


def write_config(folder: Path) -> None:
    create_folder(tiny_run("nerfacto", Path("photographs"), folder, max_seconds=60.0))
    without_place(folder)


def read_config(folder: Path, scratch: Path) -> None:
    run = read_run(folder / "config.yml")
    require(is_dataclass(run.config) and is_dataclass(run.parser), "settings of another kind")


def write_recipe(folder: Path) -> None:
    methods = "methods:\n- instant-ngp\n- vanilla-nerf --sampler occupancy\n"
    (folder / "recipe.yml").write_text(f"{methods}max_seconds: 60.0\ndata_flags: '--scale-factor 2'\n")


def read_recipe(folder: Path, scratch: Path) -> None:
    """Read the recipe of a comparison."""
    plan = plan_of(from_plain(CompareFlags(), read_yaml(folder / "recipe.yml"), "recipe.yml"))
    require(plan.contenders and plan.conditions.budget(), "a comparison of nothing")


def write_two_blocks(folder: Path) -> None:
    runs = [folder / "runs" / str(number) for number in (0, 1)]
    for run in runs:
        run.mkdir(parents=True)
        (run / "config.yml").write_text("method: instant-ngp\n")
    blocks = [TrainedBlock((0.5, 1.0, 2.0), 3.0 + number, (0, 1, 2), run) for number, run in enumerate(runs)]
    write_blocks(folder / "blocks.yml", BlockList(((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)), 0.05, 1e3, tuple(blocks)))


def read_scene_in_blocks(folder: Path, scratch: Path) -> None:
    found = read_blocks(folder / "blocks.yml")
    require(0 <= found.near < found.far and found.blocks, "a scene of nothing")
    for block in found.blocks:
        require(block.radius > 0 and all(map(math.isfinite, block.center)), "a block without a place")
        require(all(len(row) == 4 and all(map(math.isfinite, row)) for row in block.color), "colours of nothing")


def write_network(folder: Path) -> None:
    write_visibility(folder / "visibility.npz", Visibility((1.0, 2.0, 3.0), 4.0))


def read_network(folder: Path, scratch: Path) -> None:
    found = read_visibility(folder / "visibility.npz").of(torch.randn(20, 3), torch.eye(3)[[0] * 20])
    require(bool(((found >= 0) & (found <= 1)).all()), "no transmittances")


def read_checkpoints(folder: Path, scratch: Path) -> None:
    content = load_newest(folder / "run" / FOLDER)
    require(content is None or "model" in content, "a checkpoint without a model")


@cache
def _photographs(folder: Path) -> tuple[Run, Dataset]:
    """A run and its data set, for checkpoints to be restored to."""
    shutil.rmtree(folder, ignore_errors=True)
    run = tiny_run("instant-ngp", write_tiny(folder, size=8, counts=(4, 1, 1)), folder, **SMALL)
    return run, load_split(run, "train")


def restore(folder: Path, scratch: Path) -> None:
    """Restore a checkpoint as ns-eval does, and as --resume does."""
    trained = load_trained(folder / "run" / "config.yml", device_type="cpu")
    Trainer.of(*_photographs(scratch.parent / "photographs")).restore(load_checkpoint(trained.checkpoint))


def write_pixel_cache(folder: Path) -> None:
    facts = {
        "pixels": np.array(300),
        "channels": np.array(3),
        "left": np.arange(2),
        "light": np.zeros((2, 3, 5), np.float32),
        "failure": np.array(""),
    }
    (folder / "pixels.bin").write_bytes(noise(20, 15, 0).tobytes() + pack(facts))


def read_pixel_cache(folder: Path, scratch: Path) -> None:
    facts = unpack(folder / "pixels.bin")
    if facts is not None:
        pixels = MappedPixels(folder / "pixels.bin", int(facts["pixels"]), int(facts["channels"]), 1e6)
        require(len(pixels.look_up(torch.tensor([5, 3, 299]))) == 3, "pixels that are not there")


def write_exr_depths(folder: Path) -> None:
    for compression in (NONE, RLE, ZIPS, ZIP):
        depths = noise(20, 15, compression)[..., 0].astype(np.float32)
        write_exr(folder / f"{compression}.exr", {"Z": depths, "A": depths.astype(np.float16)}, compression)


def read_exr_depths(folder: Path, scratch: Path) -> None:
    for file in sorted(folder.glob("*.exr")):
        require(read_depth(file, 20, 15).shape == (15, 20), "another shape")


def write_normals(folder: Path) -> None:
    for index, channels in enumerate((3, 4)):
        iio.imwrite(folder / f"{index}_normal.png", noise(20, 15, index, channels))


def read_images_of_normals(folder: Path, scratch: Path) -> None:
    for file in sorted(folder.glob("*.png")):
        normals = read_normals(file, 20, 15)
        require(normals.shape == (15, 20, 3), "another shape")
        require(bool(((normals.norm(dim=-1) - 1).abs() < 1e-3).all()), "other lengths than 1")


def write_diffuse(folder: Path) -> None:
    light = noise(20, 15, 3)[..., :3].astype(np.float32) / 255
    np.savez_compressed(folder / "0_light.npz", diffuse=light, roughness=light[..., :1])
    np.savez(folder / "1_light.npz", diffuse=light)


def read_files_of_light(folder: Path, scratch: Path) -> None:
    for file in sorted(folder.glob("*.npz")):
        light = read_diffuse(file, 20, 15)
        require(light.shape == (15, 20, 3), "another shape")
        require(bool((light.isfinite() & (light >= 0)).all()), "light that is negative or not finite")


def write_archive(folder: Path) -> None:
    """Text, an image, and an entry that is stored as it is."""
    with zipfile.ZipFile(folder / "scenes.zip", "w") as archive:
        for name, how in (("a/b.txt", zipfile.ZIP_DEFLATED), ("a/c/d.bin", zipfile.ZIP_STORED), ("e/", 0)):
            entry = zipfile.ZipInfo(name, (2020, 1, 1, 0, 0, 0))
            archive.writestr(entry, b"" if name.endswith("/") else noise(20, 15, 0).tobytes(), how)


def unpack_archive(folder: Path, scratch: Path) -> None:
    before = {path for path in scratch.parent.rglob("*") if not path.is_relative_to(scratch)}
    try:
        downloads.unpack(folder / "scenes.zip", scratch / "out", lambda parts: parts)
    finally:
        written = {path for path in scratch.parent.rglob("*") if not path.is_relative_to(scratch)}
        require(written == before, "a file outside the folder")
        require(sum(path.stat().st_size for path in scratch.rglob("*") if path.is_file()) < 4e6, "too much")


def write_weights(folder: Path) -> None:
    """Compressed, as ten megabytes would be copied for each input."""
    arrays = {}
    for index, shape in enumerate(SHAPES):
        arrays[f"AlexNet_0.Conv_{index}.kernel"] = np.full(shape, 0.01, np.float32)
        arrays[f"AlexNet_0.Conv_{index}.bias"] = np.zeros(shape[-1], np.float32)
        arrays[f"NetLinLayer_{index}.Conv_0.kernel"] = np.ones((1, 1, shape[-1], 1), np.float32)
    np.savez_compressed(folder / "weights.npz", **arrays)


def read_lpips(folder: Path, scratch: Path) -> None:
    for layer in read_weights(folder / "weights.npz"):
        require(all(bool(values.isfinite().all()) for values in vars(layer).values()), "weights that are not finite")


def read_run_scale(folder: Path, scratch: Path) -> None:
    scale = read_scale(folder)
    require(0 < scale.factor < math.inf and 0 <= (scale.relative_error or 0) < math.inf, "a scale that is no number")


def write_edits(folder: Path) -> None:
    """A recipe of ns-edit with settings of every type, and regions of every kind."""
    steps = [
        step_of("crop_box", {"low": [-1, -1, 0], "high": [1, 1.5, 2], "keep": False}, "here"),
        step_of("crop_polygon", {"image": "a.png", "corners": [[0, 0], [3, 0], [0, 3]]}, "here"),
        step_of("scale", {"factor": 0.5, "unit": "m"}, "here"),
        step_of("align_floor", {"tolerance": None, "seed": 3}, "here"),
        step_of("merge", {"files": ["a.ply"]}, "here"),
    ]
    write_steps(folder / "edit.yml", steps)
    (folder / "region.yml").write_text("sphere: {center: [0, 0, 1], radius: 2.5}\n", encoding="utf-8")
    axes = (0.6, 0.8, 0), (-0.8, 0.6, 0), (0, 0, 1)
    view = Polygon((0, 0, 2), axes, ((0, 0), (0.5, 0), (0, 0.5)), False, "fisheye", (0.1, 0.01, 0, 0))
    write_regions(folder / "all.yml", [Box((-1, -1, 0), (1, 1.5, 2), axes), view, Sphere((0, 0, 0), 3)])


def read_edits(folder: Path, scratch: Path) -> None:
    for step in read_steps(folder / "edit.yml"):
        require(step.name in STEPS, "a step that does not exist")
    for name in ("region.yml", "all.yml"):
        for region in read_regions(folder / name):
            require(region.contains(torch.zeros(1, 3)).shape == (1,), "another shape")


READERS: dict[str, Reader] = {
    "blender": Reader(write_blender, partial(parse, Blender()), ("transforms_train.json",), ("camera_angle_x", "time")),
    "dnerf": Reader(write_dnerf, partial(parse, DNeRF()), ("transforms_train.json",), ("camera_angle_x", "time")),
    "nerfstudio": Reader(write_nerfstudio, partial(parse, Nerfstudio()), ("transforms.json", "points.ply"), CAPTURE),
    "colmap-binary": Reader(partial(write_sparse, binary=True), partial(parse, Colmap()), ("sparse/0/*.bin",)),
    "colmap-text": Reader(partial(write_sparse, binary=False), partial(parse, Colmap()), ("sparse/0/*.txt",)),
    "llff": Reader(write_llff, partial(parse, Llff()), ("poses_bounds.npy",)),
    "llff-ndc": Reader(write_llff, partial(parse, Llff(ndc=True)), ("poses_bounds.npy",)),
    "record3d": Reader(write_record3d, partial(parse, Record3D()), ("EXR_RGBD/metadata.json",), ("K", "w", "h")),
    "polycam": Reader(write_polycam, partial(parse, Polycam()), ("keyframes/cameras/*.json",), ("fx", "cx", "width")),
    "dtu": Reader(partial(write_dtu, count=COUNT), partial(parse, Dtu()), ("cameras_sphere.npz",)),
    "sdfstudio": Reader(write_sdfstudio, partial(parse, SdfStudio()), ("meta_data.json",), SDFSTUDIO),
    "phototourism": Reader(write_phototourism, partial(parse, Phototourism()), ("gate.tsv",)),
    "ply": Reader(write_ply, read_ply, ("*.ply",)),
    "surfaces": Reader(write_surfaces, read_surfaces, ("mesh.*",)),
    "splats": Reader(
        write_splats,
        read_splats,
        ("splat*", "sog/*"),
        ("version", "count", "mins", "codebook", "files", "bands", "model"),
    ),
    "levels": Reader(
        write_levels, read_some_levels, ("*.levels",), ("count", "parent", "look", "degree", "bits", "origin", "crc32")
    ),
    "octree": Reader(write_octrees, read_octrees, ("*.octree",)),
    "camera-path": Reader(write_path, read_path, ("camera_path.json",), ("crop", "camera_type", "aspect", "seconds")),
    "scale": Reader(
        lambda folder: write_scale(folder, Scale(0.25, "m", 0.01)), read_run_scale, ("scale.json",), ("factor", "unit")
    ),
    "images": Reader(write_blender, partial(load, Blender(), MEMORY), ("train/*.png",)),
    "images-to-a-file": Reader(write_blender, partial(load, Blender(), 0.0), ("train/*.png",)),
    "masks": Reader(write_masked, partial(load, Nerfstudio(), MEMORY), ("masks/*.png",)),
    "depths": Reader(write_masked, partial(load, Nerfstudio(), MEMORY), ("depths/*",)),
    "depths-exr": Reader(write_exr_depths, read_exr_depths, ("*.exr",)),
    "normals": Reader(write_normals, read_images_of_normals, ("*.png",)),
    "diffuse-light": Reader(write_diffuse, read_files_of_light, ("*.npz",)),
    "photographs": Reader(write_photographs, read_photographs, ("*",)),
    "polycam-raw": Reader(write_polycam, convert_polycam, ("keyframes/cameras/*.json",), ("blur_score", "fx", "width")),
    "record3d-raw": Reader(
        write_record3d_whole, convert_record3d, ("EXR_RGBD/metadata.json",), ("perFrameIntrinsicCoeffs", "K", "w")
    ),
    "metashape": Reader(write_metashape, partial(convert, read_metashape, "photographs"), ("cameras.xml",)),
    "realitycapture": Reader(
        write_realitycapture, partial(convert, read_realitycapture, "photographs"), ("cameras.csv",)
    ),
    "odm": Reader(write_odm, partial(convert, read_odm, "images"), ("opensfm/reconstruction.json",), OPENSFM),
    "aria": Reader(
        write_recording,
        partial(convert, read_aria, "images"),
        tuple(f"mps/slam/{name}" for name in ("closed_loop_trajectory.csv", "online_calibration.jsonl")),
    ),
    "bundler": Reader(write_bundler, partial(convert, read_bundler, "photographs"), ("bundle.out", "list.txt")),
    "config": Reader(write_config, read_config, ("config.yml",), ("method", "dataparser", "machine", "data", "name")),
    "comparison": Reader(write_recipe, read_recipe, ("recipe.yml",), ("methods", "data", "repeats", "target_psnr")),
    "edits": Reader(write_edits, read_edits, ("*.yml",), ("steps", "low", "keep", "factor", "radius", "axes")),
    "blocks": Reader(
        write_two_blocks, read_scene_in_blocks, ("blocks.yml",), ("version", "box", "run", "center", "cameras", "color")
    ),
    "visibility": Reader(write_network, read_network, ("visibility.npz",)),
    "checkpoint": Reader(write_run, read_checkpoints, ("run/nerfstudio_models/*.ckpt",)),
    "run": Reader(write_run, restore, ("run/nerfstudio_models/*.ckpt",)),
    "archive": Reader(write_archive, unpack_archive, ("scenes.zip",)),
    "pixel-cache": Reader(write_pixel_cache, read_pixel_cache, ("pixels.bin",)),
    "lpips-weights": Reader(write_weights, read_lpips, ("weights.npz",)),
}
"""Readers by name."""

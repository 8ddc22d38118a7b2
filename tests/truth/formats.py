"""The ball's capture as every format has it."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from nerfloom import DataParser
from nerfloom.dataparsers.blender import Blender
from nerfloom.dataparsers.colmap import Colmap
from nerfloom.dataparsers.dtu import Dtu
from nerfloom.dataparsers.llff import Llff
from nerfloom.dataparsers.nerfstudio import Nerfstudio
from nerfloom.dataparsers.phototourism import Phototourism
from nerfloom.dataparsers.polycam import Polycam
from nerfloom.dataparsers.record3d import Record3D
from nerfloom.dataparsers.sdfstudio import SdfStudio
from tests.dataparsers.sparse_models import Capture, write_colmap
from tests.truth.ball import (
    CENTRE,
    COUNT,
    HEIGHT,
    HELD_OUT,
    NAMES,
    PINHOLE,
    RADIUS,
    WIDTH,
    Lens,
    depth,
    opencv_pose,
    pose_of,
    surface,
    write_depths,
    write_photographs,
)

MIDDLE = Lens(intrinsics=(70.0, 70.0, WIDTH / 2, HEIGHT / 2))
"""A lens for formats with a single focal length."""
BENT = Lens("opencv", {"k1": -0.11, "k2": 0.05, "p1": 0.012, "p2": -0.008})
RATIONAL = Lens(
    "opencv",
    {"k1": 0.12, "k2": -0.2, "p1": 0.012, "p2": -0.008, "k3": 0.35, "k4": 0.17, "k5": -0.13, "k6": 0.2},
)
LONG = Lens("opencv", {"k1": -0.11, "k2": 0.05, "p1": 0.012, "p2": -0.008, "k3": 0.3, "k7": -0.6})
FISHEYE = Lens("fisheye", {"k1": 0.06, "k2": -0.09, "k3": 0.2, "k4": -0.4})
APPLIED = np.eye(4)
APPLIED[:3, :3] = Rotation.from_rotvec([0.4, -0.7, 0.3]).as_matrix()
APPLIED[:3, 3] = (0.3, 0.8, -0.5)
APPLIED_SCALE = 0.4
"""From the capture's own frame to a file's that states it: APPLIED_SCALE * (APPLIED @ x)."""


def applied(pose: np.ndarray) -> np.ndarray:
    """A pose in the frame that a file has."""
    moved = APPLIED @ pose
    moved[:3, 3] *= APPLIED_SCALE
    return moved


def write_nerfstudio(folder: Path, lens: Lens = PINHOLE, **changes: Any) -> Path:
    """The file states its frame and unit, which differ from the capture's; depth is in the capture's millimetres."""
    write_photographs(folder / "images", NAMES, lens)
    write_depths(folder / "depth", NAMES, lens)
    model, named = {"pinhole": "PINHOLE", "opencv": "OPENCV", "fisheye": "OPENCV_FISHEYE"}[lens.model], dict(lens.named)
    if "k6" in named:
        model = "FULL_OPENCV"
    elif "k7" in named:
        named["k4"] = named.pop("k7")
    fx, fy, cx, cy = lens.intrinsics
    frames = [
        {
            "file_path": f"images/{name}",
            "depth_file_path": f"depth/{name}",
            "transform_matrix": applied(pose_of(index)).tolist(),
        }
        for index, name in enumerate(NAMES)
    ]
    content = {
        "camera_model": model, "w": WIDTH, "h": HEIGHT, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy,
        **named, "applied_transform": APPLIED[:3].tolist(), "applied_scale": APPLIED_SCALE,
        "frames": frames[::-1], **changes,
    }  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def model_of(names: list[str] = NAMES) -> Capture:
    """The model that COLMAP would have found."""
    poses = np.stack([opencv_pose(index) for index in range(COUNT)])
    return Capture(names, poses[:, :, :3], poses[:, :, 3], surface())


def camera_line(model: str, order: str, lens: Lens) -> str:
    """A COLMAP camera, from the names of its parameters in COLMAP's order."""
    fx, fy, cx, cy = lens.intrinsics
    known = {**lens.named, "fx": fx, "fy": fy, "f": fx, "cx": cx, "cy": cy}
    return f"{model} {WIDTH} {HEIGHT} " + " ".join(str(known.get(name, 0.0)) for name in order.split())


ONE_FOCAL = (70.0, 70.0, 23.1, 20.7)
COLMAP_CAMERAS: dict[str, tuple[str, Lens]] = {
    "SIMPLE_PINHOLE": ("f cx cy", Lens(intrinsics=ONE_FOCAL)),
    "PINHOLE": ("fx fy cx cy", PINHOLE),
    "SIMPLE_RADIAL": ("f cx cy k1", Lens("opencv", {"k1": -0.11}, ONE_FOCAL)),
    "RADIAL": ("f cx cy k1 k2", Lens("opencv", {"k1": -0.11, "k2": 0.3}, ONE_FOCAL)),
    "OPENCV": ("fx fy cx cy k1 k2 p1 p2", BENT),
    "FULL_OPENCV": ("fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6", RATIONAL),
    "SIMPLE_RADIAL_FISHEYE": ("f cx cy k1", Lens("fisheye", {"k1": 0.2}, ONE_FOCAL)),
    "RADIAL_FISHEYE": ("f cx cy k1 k2", Lens("fisheye", {"k1": 0.2, "k2": -0.4}, ONE_FOCAL)),
    "OPENCV_FISHEYE": ("fx fy cx cy k1 k2 k3 k4", FISHEYE),
}
"""COLMAP's documentation of its camera models: the parameters' order."""


def write_sparse(folder: Path, model: str = "OPENCV", images: str = "images", sparse: str = "sparse/0") -> Path:
    """Photographs and COLMAP's model of them."""
    order, lens = COLMAP_CAMERAS[model]
    write_photographs(folder / images, NAMES, lens)
    write_colmap(folder / sparse, model_of(), camera_line(model, order, lens))
    return folder


def write_collection(folder: Path) -> Path:
    """Photographs of strangers: a model in dense/, and a table that holds two out and leaves one without an id."""
    write_sparse(folder, "SIMPLE_RADIAL", "dense/images", "dense/sparse")
    rows = ["filename\tid\tsplit\tdataset"]
    for index, name in enumerate(NAMES):
        split = "test" if name in HELD_OUT else "train"
        rows.append(f"{name}\t{'' if index == COUNT - 1 else index}\t{split}\tball")
    (folder / "ball.tsv").write_text("\n".join(rows) + "\n")
    return folder


def write_llff(folder: Path) -> Path:
    """Rows of [down, right, back, position, (height, width, focal)], near and far."""
    write_photographs(folder / "images", NAMES, MIDDLE)
    rows = []
    for index in range(COUNT):
        right, up, back, position = pose_of(index)[:3].T
        matrix = np.stack([-up, right, back, position, [HEIGHT, WIDTH, MIDDLE.intrinsics[0]]], axis=1)
        near = np.linalg.norm(position - CENTRE) - RADIUS
        rows.append([*matrix.reshape(-1), near, near + 2 * RADIUS])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


def write_blender(folder: Path) -> Path:
    """Lists of all but those held out, of two of the others, and of those held out."""
    write_photographs(folder / "all", NAMES, MIDDLE)
    angle = 2 * np.arctan(WIDTH / 2 / MIDDLE.intrinsics[0])
    train = [name for name in NAMES if name not in HELD_OUT]
    for split, names in (("train", train[2:]), ("val", train[:2]), ("test", HELD_OUT)):
        frames = [
            {"file_path": f"./all/{Path(name).stem}", "transform_matrix": pose_of(NAMES.index(name)).tolist()}
            for name in names
        ]
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    return folder


def write_polycam(folder: Path) -> Path:
    """keyframes with images, cameras and depth in millimetres."""
    keyframes = folder / "keyframes"
    write_photographs(keyframes / "images", NAMES)
    write_depths(keyframes / "depth", NAMES)
    (keyframes / "cameras").mkdir()
    fx, fy, cx, cy = PINHOLE.intrinsics
    for index, name in enumerate(NAMES):
        pose = pose_of(index)
        content = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": WIDTH, "height": HEIGHT, "blur_score": 90.0}
        content |= {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
        (keyframes / "cameras" / f"{Path(name).stem}.json").write_text(json.dumps(content))
    return folder


def write_record3d(folder: Path) -> Path:
    """EXR_RGBD with numbered images, quaternions x, y, z, w, and K column by column."""
    export = folder / "EXR_RGBD"
    write_photographs(export / "rgb", [f"{index}.png" for index in range(COUNT)])
    fx, fy, cx, cy = PINHOLE.intrinsics
    poses = [pose_of(index) for index in range(COUNT)]
    rows = [[*Rotation.from_matrix(pose[:3, :3]).as_quat(), *pose[:3, 3]] for pose in poses]
    content = {"w": WIDTH, "h": HEIGHT, "K": [fx, 0, 0, 0, fy, 0, cx, cy, 1], "poses": rows}
    (export / "metadata.json").write_text(json.dumps(content))
    return folder


def write_dtu(folder: Path) -> Path:
    """Projections for images twice as large, and a sphere."""
    write_photographs(folder / "image", [f"{index:06d}.png" for index in range(COUNT)])
    intrinsic, sphere = np.eye(3), np.diag([1.1 * RADIUS] * 3 + [1.0])
    intrinsic[[0, 1, 0, 1], [0, 1, 2, 2]] = 2 * np.array(PINHOLE.intrinsics)
    sphere[:3, 3] = CENTRE
    arrays = {f"world_mat_{index}": np.eye(4) for index in range(COUNT)}
    for index in range(COUNT):
        arrays[f"world_mat_{index}"][:3] = intrinsic @ opencv_pose(index)
        arrays[f"scale_mat_{index}"] = sphere
    np.savez(folder / "cameras_sphere.npz", **arrays)
    return folder


def write_sdfstudio(folder: Path) -> Path:
    """The file has another frame and unit than the capture's, and states them; depth is in the file's."""
    write_photographs(folder, NAMES)
    fx, fy, cx, cy = PINHOLE.intrinsics
    frames = []
    for index, name in enumerate(NAMES):
        np.save(folder / f"{index}_depth.npy", (depth(index) * APPLIED_SCALE).astype(np.float32))
        pose = applied(pose_of(index)) @ np.diag([1.0, -1, -1, 1])
        intrinsics = [[fx, 0, cx, 0], [0, fy, cy, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
        names = {"rgb_path": name, "sensor_depth_path": f"{index}_depth.npy"}
        frames.append({**names, "camtoworld": pose.tolist(), "intrinsics": intrinsics})
    back = np.linalg.inv(np.diag([APPLIED_SCALE] * 3 + [1]) @ APPLIED)
    centre = APPLIED_SCALE * (APPLIED[:3, :3] @ CENTRE + APPLIED[:3, 3])
    box = {"aabb": [(centre - 0.3).tolist(), (centre + 0.3).tolist()], "near": 0.1, "far": 2.0, "radius": 0.3}
    content = {"width": WIDTH, "height": HEIGHT, "worldtogt": back.tolist(), "scene_box": box, "frames": frames}
    (folder / "meta_data.json").write_text(json.dumps(content))
    return folder


@dataclass(frozen=True)
class Format:
    """A capture on the disk, and who reads it."""

    parser: DataParser
    write: Callable[[Path], Path]
    train: tuple[str, ...]
    """Stems of the photographs to learn from."""
    val: tuple[str, ...]
    test: tuple[str, ...]
    steps: float | None = None
    """A metre in steps of the depth images; None without any."""


STEMS = tuple(Path(name).stem for name in NAMES)
HELD = tuple(Path(name).stem for name in HELD_OUT)
REST = tuple(stem for stem in STEMS if stem not in HELD)


def _every_eighth(parser: DataParser, write: Callable[[Path], Path], steps: float | None = None) -> Format:
    return Format(parser, write, REST, HELD, HELD, steps)


def _lists(**names: list[str]) -> Callable[[Path], Path]:
    listed = {f"{split}_filenames": [f"images/{name}" for name in of_split] for split, of_split in names.items()}
    return lambda folder: write_nerfstudio(folder, **listed)


def _but(*places: int) -> tuple[str, ...]:
    return tuple(stem for index, stem in enumerate(STEMS) if index not in places)


FORMATS: dict[str, Format] = {
    "nerfstudio": _every_eighth(Nerfstudio(), write_nerfstudio, 1000.0),
    "nerfstudio, twice as large": _every_eighth(Nerfstudio(scale_factor=2.0), write_nerfstudio, 1000.0),
    "nerfstudio, as it is": _every_eighth(
        Nerfstudio(orientation_method="none", center_method="none", auto_scale_poses=False), write_nerfstudio, 1000.0
    ),
    "nerfstudio, pca and focus": _every_eighth(
        Nerfstudio(orientation_method="pca", center_method="focus"), write_nerfstudio, 1000.0
    ),
    "nerfstudio, bent": _every_eighth(Nerfstudio(), lambda f: write_nerfstudio(f, BENT), 1000.0),
    "nerfstudio, rational": _every_eighth(Nerfstudio(), lambda f: write_nerfstudio(f, RATIONAL), 1000.0),
    "nerfstudio, to r^8": _every_eighth(Nerfstudio(), lambda f: write_nerfstudio(f, LONG), 1000.0),
    "nerfstudio, fisheye": _every_eighth(Nerfstudio(), lambda f: write_nerfstudio(f, FISHEYE), 1000.0),
    "nerfstudio, val listed": Format(
        Nerfstudio(), _lists(val=NAMES[2:4]), _but(2, 3), STEMS[2:4], STEMS[2:4], 1000.0
    ),
    "nerfstudio, test listed": Format(
        Nerfstudio(), _lists(test=NAMES[5:7]), _but(5, 6), STEMS[5:7], STEMS[5:7], 1000.0
    ),
    "nerfstudio, val and test listed": Format(
        Nerfstudio(), _lists(val=NAMES[2:4], test=NAMES[5:7]), _but(2, 3, 5, 6), STEMS[2:4], STEMS[5:7], 1000.0
    ),
    "nerfstudio, all listed": Format(
        Nerfstudio(), _lists(train=NAMES[7:], val=NAMES[2:4], test=NAMES[5:7]),
        STEMS[7:], STEMS[2:4], STEMS[5:7], 1000.0,
    ),
    "nerfstudio, a fraction": Format(
        Nerfstudio(eval_mode="fraction", train_split_fraction=0.5), write_nerfstudio,
        tuple(STEMS[i] for i in (0, 2, 4, 6, 8, 11)), tuple(STEMS[i] for i in (1, 3, 5, 7, 9, 10)),
        tuple(STEMS[i] for i in (1, 3, 5, 7, 9, 10)), 1000.0,
    ),
    **{
        f"colmap, {model}": _every_eighth(Colmap(), lambda f, model=model: write_sparse(f, model))  # type: ignore[misc]
        for model in COLMAP_CAMERAS
    },
    "phototourism": Format(Phototourism(), write_collection, REST[:-1], HELD, HELD),
    "llff": _every_eighth(Llff(), write_llff),
    "blender": Format(Blender(near=1.2, far=2.8), write_blender, REST[2:], REST[:2], HELD),
    "blender, twice as large": Format(
        Blender(near=1.2, far=2.8, scale_factor=2.0), write_blender, REST[2:], REST[:2], HELD
    ),
    "dtu": Format(
        Dtu(), write_dtu, tuple(f"{int(stem):06d}" for stem in REST), ("000000", "000008"), ("000000", "000008")
    ),
    "sdfstudio": _every_eighth(SdfStudio(), write_sdfstudio, 1000.0),
    "polycam": _every_eighth(Polycam(), write_polycam, 1000.0),
    "record3d": Format(
        Record3D(), write_record3d, tuple(str(int(stem)) for stem in REST), ("0", "8"), ("0", "8")
    ),
}  # fmt: skip

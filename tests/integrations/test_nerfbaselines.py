"""nerfbaselines: its registry's schema is met, its data are read as it means them, and its protocol runs without it."""

from __future__ import annotations

import dataclasses
import importlib
import json
import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from nerfloom.base.errors import CheckpointError, ConfigError, DataError
from nerfloom.base.plain import from_plain
from nerfloom.data.dataset import load_dataset
from nerfloom.dataparsers.blender import Blender
from nerfloom.integrations.nerfbaselines import (
    InstantNGP,
    KPlanes,
    Nerfacto,
    NerfloomMethod,
    TensoRF,
    VanillaNeRF,
)
from nerfloom.integrations.nerfbaselines_data import ArrayImages, Frame, FrameFlags, cameras_of, dataset_of
from nerfloom.integrations.nerfbaselines_settings import flattened, parse_overrides
from nerfloom.integrations.nerfbaselines_spec import SPECS
from nerfloom.registry import load_method, registered
from tests.conftest import ball_view
from tests.forked import Forks
from tests.training.helpers import TINY

ROOT = Path(__file__).parents[2]
METHODS = [InstantNGP, KPlanes, Nerfacto, TensoRF, VanillaNeRF]
SIZE, COUNT = 16, 8
CPU = {"machine.device_type": "cpu"}


@dataclasses.dataclass(frozen=True)
class Cameras:
    """The used part of nerfbaselines' cameras (`GenericCamerasImpl` in its nerfbaselines/_types.py)."""

    poses: np.ndarray
    intrinsics: np.ndarray
    camera_models: np.ndarray
    distortion_parameters: np.ndarray
    image_sizes: np.ndarray
    nears_fars: np.ndarray | None = None

    def __len__(self) -> int:
        return 1 if self.poses.ndim == 2 else len(self.poses)

    def __getitem__(self, index: Any) -> Cameras:
        values = (getattr(self, field.name) for field in dataclasses.fields(self))
        return Cameras(*(None if value is None else value[index] for value in values))

    def __iter__(self) -> Iterator[Cameras]:
        return (self[index] for index in range(len(self)))

    def item(self) -> Cameras:
        assert len(self) == 1
        return self if self.poses.ndim == 2 else self[0]


def cameras(poses: np.ndarray, size: int, **changes: Any) -> Cameras:
    """Pinhole cameras of square pictures, poses with OpenCV's axes; the field of view is `ball_view`'s."""
    count, focal = len(poses), 0.5 * size / math.tan(0.35)
    values: dict[str, Any] = {
        "intrinsics": np.tile(np.array([focal, focal, size / 2, size / 2], np.float32), (count, 1)),
        "camera_models": np.zeros(count, np.int32),
        "distortion_parameters": np.zeros((count, 0), np.float32),
        "image_sizes": np.full((count, 2), size, np.int32),
        "nears_fars": np.tile(np.array([2, 6], np.float32), (count, 1)),
    }
    return Cameras(poses.astype(np.float32), **{**values, **changes})


def handed(channels: int = 4, **metadata: Any) -> dict[str, Any]:
    """A ball of radius 1 as nerfbaselines would hand it over, with alpha or over white."""
    views = [ball_view(2 * math.pi * index / COUNT, SIZE) for index in range(COUNT)]
    images = [image if channels == 4 else over_white(image) for image, _ in views]
    poses = np.array([pose for _, pose in views])[:, :3] * [1, -1, -1, 1]
    white = np.array([255, 255, 255], np.uint8)
    return {
        "cameras": cameras(poses, SIZE),
        "images": images,
        "image_paths": [f"/nowhere/{index:03d}.png" for index in range(COUNT)],
        "image_paths_root": "/nowhere",
        "masks": None,
        "points3D_xyz": None,
        "metadata": {"id": "ball", "color_space": "srgb", "background_color": white, **metadata},
    }


def over_white(image: np.ndarray) -> np.ndarray:
    alpha = image[..., 3:] / 255
    return (image[..., :3] * alpha + 255 * (1 - alpha)).round().astype(np.uint8)


def start(method: type[NerfloomMethod], data: dict[str, Any], **overrides: Any) -> NerfloomMethod:
    """A tiny model of a method, at its start."""
    return method(train_dataset=data, config_overrides={**TINY[method.name], **CPU, **overrides})


def same(first: dict[str, np.ndarray], second: dict[str, np.ndarray]) -> bool:
    return first.keys() == second.keys() and all(np.array_equal(first[name], second[name]) for name in first)


# -- the spec ---------------------------------------------------------------------------------------------------

# MethodSpec, BackendName, DatasetFeature, CameraModel, ImplementationStatus, LicenseSpec: nerfbaselines/_types.py at
# commit 8079977d0480277aef41f3bda5707c0910fda553 of nerfbaselines/nerfbaselines.
REQUIRED = {"id": str, "method_class": str}
OPTIONAL = {
    "conda": dict,
    "docker": dict,
    "apptainer": dict,
    "metadata": dict,
    "backends_order": list,
    "presets": dict,
    "required_features": list,
    "supported_camera_models": list,
    "supported_outputs": list,
    "output_artifacts": dict,
    "implementation_status": dict,
}
BACKENDS = {"conda", "docker", "apptainer", "python"}
FEATURES = {
    "color",
    "points3D_xyz",
    "points3D_rgb",
    "images_points3D_indices",
    "images_points2D_xy",
    "points3D_error",
}
CAMERA_MODELS = ["pinhole", "opencv", "opencv_fisheye", "full_opencv"]
STATUS = {"working", "reproducing", "not-working", "working-not-reproducing"}


@pytest.mark.parametrize("spec", SPECS, ids=lambda spec: spec["id"])
def test_a_spec_meets_the_schema(spec: dict[str, Any]) -> None:
    assert REQUIRED.keys() <= spec.keys() <= REQUIRED.keys() | OPTIONAL.keys()
    for key, value in spec.items():
        assert isinstance(value, (REQUIRED | OPTIONAL)[key]), key
    assert set(spec["backends_order"]) <= BACKENDS
    assert set(spec["required_features"]) <= FEATURES
    assert set(spec["supported_camera_models"]) <= set(CAMERA_MODELS)
    assert all(isinstance(output, str) for output in spec["supported_outputs"])
    assert set(spec.get("implementation_status", {}).values()) <= STATUS
    assert all(isinstance(license["name"], str) for license in spec["metadata"]["licenses"])
    assert json.loads(json.dumps(spec)) == spec  # `nerfbaselines install` writes it down


def test_ids_are_unique_and_a_method_has_one_spec() -> None:
    assert len({spec["id"] for spec in SPECS}) == len(SPECS) == len(METHODS)
    assert {spec["id"] for spec in SPECS} == {f"nerfloom-{method.name}" for method in METHODS}


@pytest.mark.parametrize("spec", SPECS, ids=lambda spec: spec["id"])
def test_a_spec_names_a_class_whose_method_is_known_and_that_says_the_same(spec: dict[str, Any]) -> None:
    module, _, name = spec["method_class"].partition(":")
    method = getattr(importlib.import_module(module), name)
    assert issubclass(method, NerfloomMethod)
    assert method.name in registered("methods")
    assert spec["id"] == f"nerfloom-{method.name}"
    info = method.get_method_info()
    assert info["required_features"] == frozenset(spec["required_features"])
    assert info["supported_camera_models"] == frozenset(spec["supported_camera_models"])
    assert info["supported_outputs"] == tuple(spec["supported_outputs"])


@pytest.mark.parametrize("spec", SPECS, ids=lambda spec: spec["id"])
def test_presets_are_settings_that_the_method_has(spec: dict[str, Any]) -> None:
    method = spec["id"].removeprefix("nerfloom-")
    for preset in spec["presets"].values():
        assert all(set(condition) <= {"dataset", "scene", "type"} for condition in preset["@apply"])
        settings = parse_overrides({key: value for key, value in preset.items() if not key.startswith("@")})
        from_plain(FrameFlags(), settings.pop("frame", {}), "frame")
        from_plain(load_method(method).config, settings, "preset")


WITHOUT = "import sys; sys.modules['nerfbaselines'] = None; import {0}; assert '{1}' not in sys.modules"
"""A program that imports one module and must not import another."""


def test_without_nerfbaselines_the_spec_is_imported_and_not_torch() -> None:
    code = WITHOUT.format("nerfloom.integrations.nerfbaselines_spec", "torch")
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


@pytest.mark.medium
def test_without_nerfbaselines_the_methods_are_imported(forks: Forks) -> None:
    done = forks.run(WITHOUT.format("nerfloom.integrations.nerfbaselines", "methods"))
    assert done.returncode == 0, done.stderr


def test_the_spec_is_an_entry_point() -> None:
    tomllib = pytest.importorskip("tomllib", reason="Python 3.10 has no tomllib")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    specs = project["entry-points"]["nerfbaselines.specs"]
    assert specs == {"nerfloom": "nerfloom.integrations.nerfbaselines_spec"}


def test_the_page_names_every_method() -> None:
    text = (ROOT / "docs" / "guides" / "nerfbaselines.md").read_text(encoding="utf-8")
    assert [spec["id"] for spec in SPECS if f"`{spec['id']}`" not in text] == []


def test_nerfbaselines_knows_the_methods() -> None:
    nerfbaselines = pytest.importorskip("nerfbaselines", reason="nerfbaselines is not installed")
    schema = nerfbaselines.MethodSpec
    for given, method in zip(SPECS, METHODS, strict=True):
        assert given["id"] in nerfbaselines.get_supported_methods()
        spec = nerfbaselines.get_method_spec(given["id"])
        assert schema.__required_keys__ <= spec.keys() <= schema.__annotations__.keys()
        assert issubclass(method, nerfbaselines.Method)
        with nerfbaselines.build_method_class(spec, backend="python") as built:
            assert built.get_method_info()["method_id"] == given["id"]


# -- the data ---------------------------------------------------------------------------------------------------


def test_a_blender_scene_is_the_one_that_its_files_make(shared_tiny: Path) -> None:
    """Poses, rays, pixels, box: as the data parser has them, which reads OpenGL's axes from the files."""
    frames = json.loads((shared_tiny / "transforms_train.json").read_text())["frames"]
    paths = [shared_tiny / f"{frame['file_path']}.png" for frame in frames]
    poses = np.array([frame["transform_matrix"] for frame in frames])[:, :3] * [1, -1, -1, 1]
    data = {
        **handed(),
        "cameras": cameras(poses, 20),
        "images": [iio.imread(path) for path in paths],
        "image_paths": list(map(str, paths)),
    }
    photographs = ArrayImages.of(data)
    found = dataset_of(photographs, Frame.of(photographs, FrameFlags(half_size=1.5)), "ignored")
    expected = load_dataset(Blender().parse(shared_tiny, "train"), "train")
    assert torch.equal(found.pixels, expected.pixels)
    assert found.names == expected.names
    flat = torch.arange(0, len(found.pixels), 7)
    rays = [each.cameras.pixel_rays(flat, each.scene.near, each.scene.far) for each in (found, expected)]
    for name in ("origins", "directions", "nears", "fars", "pixel_radii"):
        assert torch.allclose(getattr(rays[0], name), getattr(rays[1], name), atol=1e-6), name
    assert torch.allclose(found.scene.box, expected.scene.box, atol=1e-4)
    for fact in ("near", "far", "has_alpha", "unbounded", "poses", "moving", "image_size", "num_cameras"):
        assert getattr(found.scene, fact) == getattr(expected.scene, fact), fact


LENSES = {
    "pinhole": (),
    "opencv": (0.1, -0.05, 0.01, -0.02),
    "opencv_fisheye": (0.05, 0.02, 0, 0, -0.01, 0.003),
    "full_opencv": (0.1, -0.05, 0.01, -0.02, 0.01, 0.05, 0.02, 0.004),
}


def seen_at(model: str, k: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, 2) where a camera with OpenCV's axes shows points (N, 3) of its frame, as OpenCV's documentation says."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = x * x + y * y
    if model == "opencv_fisheye":
        r = np.sqrt(r2)
        angle = np.arctan(r)
        bent = angle * (1 + k[0] * angle**2 + k[1] * angle**4 + k[4] * angle**6 + k[5] * angle**8)
        return np.stack([x, y], -1) * (bent / r)[:, None]
    k = np.pad(k, (0, 8 - len(k)))
    scale = (1 + k[0] * r2 + k[1] * r2**2 + k[4] * r2**3) / (1 + k[5] * r2 + k[6] * r2**2 + k[7] * r2**3)
    across = 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x), k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y
    return np.stack([x * scale + across[0], y * scale + across[1]], -1)


@pytest.mark.parametrize("model", CAMERA_MODELS)
def test_a_lens_shows_points_where_opencv_says(model: str) -> None:
    generator = np.random.default_rng(0)
    points = generator.uniform([-0.4, -0.4, 1], [0.4, 0.4, 2], (50, 3))
    turn = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    pose = np.concatenate([turn * np.linalg.det(turn), [[1], [2], [3]]], axis=1)
    coefficients = np.array(LENSES[model])
    given = cameras(
        pose[None],
        40,
        intrinsics=np.array([[50, 45, 21, 18]], np.float64),
        camera_models=np.array([CAMERA_MODELS.index(model)]),
        distortion_parameters=coefficients[None],
    )
    found = cameras_of(given, ["a"])
    found = dataclasses.replace(found, camera_to_worlds=found.camera_to_worlds.float())
    world = torch.from_numpy(points @ pose[:, :3].T + pose[:, 3]).float()
    columns, rows, ahead = found.project(world, 0)
    expected = seen_at(model, coefficients, points) * [50, 45] + [21, 18]
    assert bool(ahead.all())
    assert np.abs(columns.numpy() + 0.5 - expected[:, 0]).max() < 1e-3
    assert np.abs(rows.numpy() + 0.5 - expected[:, 1]).max() < 1e-3


@pytest.mark.parametrize("kind", ["bool", "uint8", "padded", "channel"])
def test_masks_say_where_to_learn(kind: str) -> None:
    used = np.random.default_rng(0).random((COUNT, SIZE, SIZE)) < 0.6
    masks = {
        "bool": list(used),
        "uint8": list(np.where(used, 255, 0).astype(np.uint8)),
        "padded": np.pad(used, ((0, 0), (0, 3), (0, 5)), constant_values=True),
        "channel": list(used[..., None]),
    }[kind]
    photographs = ArrayImages.of({**handed(3), "masks": masks})
    data = dataset_of(photographs, Frame.of(photographs, FrameFlags()), "ignored")
    assert data.kept is not None
    assert np.array_equal(data.kept.mask(0, len(data.pixels)).numpy(), used.reshape(-1))


def test_masks_count_under_their_first_name_too() -> None:
    used = np.random.default_rng(0).random((COUNT, SIZE, SIZE)) < 0.6
    data = handed(3)
    del data["masks"]
    kept = ArrayImages.of({**data, "sampling_masks": list(used)}).decoded.kept
    assert kept is not None
    assert np.array_equal(kept.mask(0, used.size).numpy(), used.reshape(-1))


def test_a_capture_is_placed_and_its_rays_start_before_its_points() -> None:
    """Cameras at 4 from a ball: the nearest of its points are 3 away, and positions come to lie within [-1, 1]."""
    around = np.random.default_rng(0).normal(size=(500, 3))
    points = around / np.linalg.norm(around, axis=-1, keepdims=True)
    photographs = ArrayImages.of({**handed(3), "points3D_xyz": points})
    frame = Frame.of(photographs, FrameFlags())
    assert frame.unbounded
    placed = frame.placed(photographs.cameras).camera_to_worlds[:, :, 3]
    assert float(placed.abs().max()) == pytest.approx(1, abs=1e-5)
    assert frame.near == pytest.approx(0.5 * 3 * frame.placement.scale, rel=0.1)
    bounded = Frame.of(ArrayImages.of(handed(3)), FrameFlags())
    assert bounded.near == pytest.approx(0.9 * 2 * bounded.placement.scale, rel=1e-5)


def test_a_box_is_as_large_as_what_lies_between_the_depths_unless_told() -> None:
    photographs = ArrayImages.of(handed())
    assert torch.allclose(Frame.of(photographs, FrameFlags()).box, torch.tensor([[-2.0] * 3, [2.0] * 3]), atol=1e-4)
    told = Frame.of(photographs, FrameFlags(half_size=1.25))
    assert torch.allclose(told.box, torch.tensor([[-1.25] * 3, [1.25] * 3]), atol=1e-4)
    silent = Frame.of(dataclasses.replace(photographs, bounds=None), FrameFlags())
    assert torch.allclose(silent.box, torch.tensor([[-2.0] * 3, [2.0] * 3]), atol=1e-4)  # half of 4, the distance
    with pytest.raises(DataError, match=r"set frame\.half_size"):
        Frame.of(photographs, FrameFlags(half_size=0.0))


def test_bad_data_are_refused() -> None:
    with pytest.raises(DataError, match="colours are linear"):
        ArrayImages.of(handed(color_space="linear"))
    with pytest.raises(DataError, match=r"000\.png is 16x15 pixels, .* 16x16"):
        ArrayImages.of({**handed(), "images": [image[1:] for image in handed()["images"]]})
    with pytest.raises(DataError, match="it must be uint8"):
        ArrayImages.of({**handed(), "images": [image / 255 for image in handed()["images"]]})
    scaled = handed()["cameras"].poses * 2
    with pytest.raises(DataError, match=r"000\.png: the pose is not rigid"):
        ArrayImages.of({**handed(), "cameras": cameras(scaled, SIZE)})


# -- settings ---------------------------------------------------------------------------------------------------


def test_overrides_are_read_from_text() -> None:
    text = {
        "machine.seed": "7",
        "max_num_iterations": "70_000",
        "lr_final": "1e-3",
        "camera_optimizer": "off",
        "num_proposal_samples": "(24, 12)",
        "predict_normals": "true",
        "appearance": "None",
    }
    config = from_plain(load_method("nerfacto").config, parse_overrides(text), "text")
    flat = flattened(dataclasses.asdict(config))
    assert {name: flat[name] for name in text} == {
        "machine.seed": 7,
        "max_num_iterations": 70_000,
        "lr_final": 1e-3,
        "camera_optimizer": "off",
        "num_proposal_samples": (24, 12),
        "predict_normals": True,
        "appearance": "auto",
    }
    with pytest.raises(ConfigError, match=r"unknown key 'leraning_rate'\. Did you mean 'learning_rate'"):
        InstantNGP(train_dataset=handed(), config_overrides={"leraning_rate": "1"})


def test_training_over_a_fixed_colour_gives_way_to_another_one_of_the_data() -> None:
    assert start(VanillaNeRF, handed()).get_info()["hparams"]["background"] == "white"
    black = handed(background_color=np.zeros(3, np.uint8))
    assert start(VanillaNeRF, black).get_info()["hparams"]["background"] == "random"
    assert start(InstantNGP, black).get_info()["hparams"]["background"] == "auto"


# -- the protocol -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)
def test_what_was_saved_shows_the_same_picture_and_learns_on(method: type[NerfloomMethod], tmp_path: Path) -> None:
    data = handed()
    first = start(method, data, max_num_iterations=20)
    assert first.get_info()["num_iterations"] == 20
    assert first.get_info()["loaded_step"] is first.get_info()["loaded_checkpoint"] is None
    for step in range(4):
        assert math.isfinite(first.train_iteration(step)["loss"])
    picture = first.render(data["cameras"][2])
    first.save(str(tmp_path / "first"))

    second = method(checkpoint=str(tmp_path / "first"), config_overrides=CPU)
    assert same(second.render(data["cameras"][2]), picture)
    info = second.get_info()
    assert (info["loaded_step"], info["loaded_checkpoint"]) == (4, str(tmp_path / "first"))
    assert info["hparams"] == first.get_info()["hparams"]
    second.save(str(tmp_path / "second"))
    files = sorted(path.relative_to(tmp_path / "first") for path in (tmp_path / "first").rglob("*") if path.is_file())
    assert len(files) == 2
    assert all((tmp_path / "first" / file).read_bytes() == (tmp_path / "second" / file).read_bytes() for file in files)

    third = method(checkpoint=str(tmp_path / "second"), train_dataset=data)
    assert same(third.render(data["cameras"][2]), picture)
    assert third.train_iteration(4) == first.train_iteration(4)
    assert same(third.render(data["cameras"][2]), first.render(data["cameras"][2]))


@pytest.mark.medium
def test_it_learns_what_the_photographs_show() -> None:
    data = handed()
    method = start(InstantNGP, data, max_num_iterations=120)
    expected = np.stack([over_white(image) for image in data["images"]]) / 255

    def error() -> float:
        pictures = np.stack([method.render(camera)["color"] for camera in data["cameras"]])
        return float(np.square(pictures - expected).mean())

    before = error()
    for step in range(120):
        method.train_iteration(step)
    after = error()
    print(f"mean squared error {before:.4f} -> {after:.4f} in 120 steps")
    assert after < before / 4


def test_pictures_are_of_the_camera_s_size_over_the_data_s_background() -> None:
    data = handed(background_color=np.array([255, 0, 51], np.uint8))
    method = start(InstantNGP, data)
    focal = np.array([20, 20, 12, 5], np.float32)
    away = data["cameras"].poses[:1] * [-1, 1, -1, 1]  # turned about its own y axis: nothing but background
    camera = cameras(away, SIZE, intrinsics=focal[None], image_sizes=np.array([[24, 10]]))
    picture = method.render(camera, options={"embedding": None})
    assert {name: (values.shape, values.dtype.name) for name, values in picture.items()} == {
        "color": ((10, 24, 3), "float32"),
        "depth": ((10, 24), "float32"),
        "accumulation": ((10, 24), "float32"),
    }
    assert np.allclose(picture["color"], [1, 0, 0.2])
    assert np.all(picture["accumulation"] == 0)


@pytest.mark.medium
def test_appearances_are_told_optimised_and_shown(tmp_path: Path) -> None:
    data = handed(3)
    method = start(Nerfacto, data, appearance="vector", appearance_embedding_dim=4)
    for step in range(3):
        method.train_iteration(step)
    method.save(str(tmp_path))
    method = Nerfacto(checkpoint=str(tmp_path), config_overrides=CPU)
    learnt = [method.get_train_embedding(index) for index in range(COUNT)]
    assert all(vector is not None and vector.shape == (4,) for vector in learnt)
    one = {**data, "cameras": data["cameras"][[3]], "images": data["images"][3:4], "image_paths": ["a.png"]}
    found = method.optimize_embedding(one)["embedding"]
    assert found.shape == (4,)
    assert np.isfinite(found).all()
    again = method.optimize_embedding(one, embedding=found)["embedding"]
    assert np.allclose(found, again, atol=1e-2)  # it ends where it is closest
    far = method.optimize_embedding(one, embedding=found + 10)["embedding"]
    assert not np.array_equal(found, far)  # the start that is given counts
    plain = method.render(data["cameras"][3])["color"]
    mean = torch.from_numpy(np.stack([vector for vector in learnt if vector is not None])).mean(0).numpy()
    assert np.allclose(method.render(data["cameras"][3], options={"embedding": mean})["color"], plain, atol=1e-6)
    shown = method.render(data["cameras"][3], options={"embedding": found})["color"]
    target = data["images"][3] / 255
    assert np.square(shown - target).mean() < np.square(plain - target).mean()


def test_a_method_without_appearances_says_so() -> None:
    method = start(InstantNGP, handed())
    assert method.get_train_embedding(0) is None
    with pytest.raises(NotImplementedError):
        method.optimize_embedding(handed())


def test_misuse_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="needs training images or a checkpoint"):
        InstantNGP()
    with pytest.raises(CheckpointError, match="has no checkpoint"):
        InstantNGP(checkpoint=str(tmp_path))
    method = start(InstantNGP, handed())
    with pytest.raises(ConfigError, match="step 3 is not the next step, 0"):
        method.train_iteration(3)
    method.save(str(tmp_path))
    with pytest.raises(CheckpointError, match="is a checkpoint of instant-ngp, not of kplanes"):
        KPlanes(checkpoint=str(tmp_path))
    with pytest.raises(ConfigError, match="loaded without"):
        InstantNGP(checkpoint=str(tmp_path), config_overrides=CPU).train_iteration(0)
    (tmp_path / "pictures.json").write_text("{")
    with pytest.raises(CheckpointError, match=r"pictures\.json is missing or damaged"):
        InstantNGP(checkpoint=str(tmp_path))

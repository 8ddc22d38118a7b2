"""COLMAP through pycolmap 3.10 and later, whose names differ between versions. These functions run in `run_apart`."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from framework.base.errors import DataError
from framework.tools.processing.settings import ColmapFlags
from framework.tools.processing.worker import Report

MANY = 10
"""Photographs of a camera from which its principal point is adjusted too."""


@dataclass(frozen=True)
class Model:
    """A reconstruction as COLMAP gives it: world to camera, y down."""

    cameras: dict[int, tuple[str, int, int, list[float]]]
    """Name of the lens model, width, height and parameters of each camera."""
    images: dict[str, tuple[int, int, np.ndarray]]
    """Image number, camera number and (3, 4) world-to-camera matrix by the photograph's name."""
    points: np.ndarray
    """(K, 3) float64."""
    colors: np.ndarray
    """(K, 3) uint8."""
    error: float
    """Mean reprojection error, pixels."""


def require() -> None:
    """Raises: DataError that says what to install where pycolmap is absent."""
    if find_spec("pycolmap") is None:
        raise DataError("finding camera poses needs COLMAP: pip install pycolmap")


def extract(
    report: Report, database: Path, images: Path, groups: list[list[str]], masks: Path | None, flags: ColmapFlags
) -> None:
    """Find features; the photographs of a group, by name, share a camera."""
    import pycolmap

    sift = _extraction_options(pycolmap)
    _set(sift, "max_image_size", flags.max_image_size)
    _set(sift, "max_num_features", flags.max_num_features)
    _set(sift, "num_threads", flags.num_threads)
    reader = pycolmap.ImageReaderOptions()
    _set(reader, "camera_model", flags.camera_model)
    if masks is not None:
        reader.mask_path = str(masks)
    usage = pycolmap.extract_features.__doc__ or ""
    named = "image_names" if "image_names:" in usage else "image_list"  # before 3.12
    options = "extraction_options" if "extraction_options:" in usage else "sift_options"  # before 3.13
    more = {"camera_model": flags.camera_model} if "camera_model:" in usage else {}  # before 4
    for group in groups:
        pycolmap.extract_features(
            str(database),
            str(images),
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            device=_device(pycolmap, flags),
            **{named: group, options: sift},
            **more,
        )


def match_pairs(
    report: Report, database: Path, pairs: list[tuple[str, str]], list_path: Path, everything: bool, flags: ColmapFlags
) -> None:
    """Compare pairs of photographs, by name; `everything` says that they are all the pairs there are."""
    import pycolmap

    list_path.write_text("".join(f"{first} {second}\n" for first, second in pairs), encoding="utf-8")
    usage = pycolmap.match_exhaustive.__doc__ or ""
    if "pairing_options:" in usage:
        name, options = "matching_options", pycolmap.FeatureMatchingOptions()
    else:  # before 3.13
        name, options = "sift_options", pycolmap.SiftMatchingOptions()
    _set(options, "num_threads", flags.num_threads)
    settings = {name: options, "device": _device(pycolmap, flags)}
    if everything:
        pycolmap.match_exhaustive(str(database), **settings)
    elif hasattr(pycolmap, "match_image_pairs"):
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = str(list_path)
        pycolmap.match_image_pairs(str(database), pairing_options=pairing, **settings)
    else:
        from framework.tools.processing.pair_matching import write_matches

        write_matches(report, database, pairs)
        pycolmap.verify_matches(str(database), str(list_path))


def reconstruct(report: Report, database: Path, images: Path, output: Path, flags: ColmapFlags) -> list[int]:
    """Place cameras one after the other, and write the models found to output/0, output/1, ... from large to small.

    Returns: the number of registered photographs of each model; empty where none was found.
    """
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = flags.num_threads
    options.min_model_size = 3
    placed = 0

    def another(pair: bool = False) -> None:
        nonlocal placed
        placed += 2 if pair else 1
        report(placed)

    raw = output.with_name(output.name + "_raw")
    raw.mkdir(parents=True)
    models = pycolmap.incremental_mapping(
        str(database),
        str(images),
        str(raw),
        options=options,
        initial_image_pair_callback=lambda: another(pair=True),
        next_image_callback=another,
    )
    ordered = sorted(models.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
    for index, model in enumerate(ordered):
        if flags.refine_intrinsics and index == 0:
            _refine(pycolmap, model)
        (output / str(index)).mkdir(parents=True)
        model.write(str(output / str(index)))
    shutil.rmtree(raw)
    return [model.num_reg_images() for model in ordered]


def undistort(report: Report, model: Path, images: Path, output: Path) -> None:
    """Write the registered photographs without distortion to output/images, and their model to output/sparse."""
    import pycolmap

    pycolmap.undistort_images(str(output), str(model), str(images), output_type="COLMAP")


def read_model(report: Report, folder: Path) -> Model:
    """Read a model from a folder with cameras.bin, images.bin and points3D.bin.

    Raises: DataError where there is none.
    """
    import pycolmap

    try:
        model = pycolmap.Reconstruction(str(folder))
    except Exception as error:  # pycolmap raises ValueError, RuntimeError and more
        raise DataError(f"{folder} holds no COLMAP model that can be read") from error
    cameras = {
        number: (_lens(camera), int(camera.width), int(camera.height), [float(p) for p in camera.params])
        for number, camera in model.cameras.items()
    }
    images = {}
    for number in model.reg_image_ids():
        image = model.images[number]
        pose = image.cam_from_world
        pose = pose() if callable(pose) else pose  # a property before 3.12
        images[image.name] = (int(number), int(image.camera_id), np.array(pose.matrix()))
    points = list(model.points3D.values())
    return Model(
        cameras,
        images,
        np.array([point.xyz for point in points], np.float64).reshape(-1, 3),
        np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        float(model.compute_mean_reprojection_error()),
    )


def _refine(pycolmap: Any, model: Any) -> None:
    """Adjust cameras, points and lenses together, with the principal point free where photographs determine it."""
    used = [model.images[number].camera_id for number in model.reg_image_ids()]
    if min(used.count(camera) for camera in set(used)) < MANY:
        return
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    pycolmap.bundle_adjustment(model, options)
    if hasattr(model, "update_point_3d_errors"):
        model.update_point_3d_errors()


def _extraction_options(pycolmap: Any) -> Any:
    if hasattr(pycolmap, "FeatureExtractionOptions"):
        return pycolmap.FeatureExtractionOptions()
    return pycolmap.SiftExtractionOptions()  # before 3.13


def _set(options: Any, name: str, value: Any) -> None:
    """Set an option, which later versions keep in `options.sift`."""
    setattr(options if hasattr(options, name) else options.sift, name, value)


def _device(pycolmap: Any, flags: ColmapFlags) -> Any:
    if flags.device_type == "cuda" and not pycolmap.has_cuda:
        raise DataError("--device-type cuda: this pycolmap was built without it; leave the flag out")
    return getattr(pycolmap.Device, flags.device_type)


def _lens(camera: Any) -> str:
    name = getattr(camera, "model_name", None)
    return str(name if name is not None else camera.model.name)

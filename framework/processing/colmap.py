"""COLMAP by pycolmap 3.10 or later; names differ between versions. These functions run in a child process."""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from nerfloom.base.errors import DataError
from nerfloom.processing.pair_matching import write_matches
from nerfloom.processing.settings import ColmapFlags
from nerfloom.processing.worker import Report

FIRST_PAIRS = 8
"""Number of pairs matched first, to estimate the total time; no part has fewer."""
SECONDS_OF_A_PART = 5.0
"""Interval of adding matches to the database, seconds; stopping loses at most this much."""
MAX_PAIRS = 1000
"""Maximum number of pairs in a part."""
MIN_IMAGES_OF_CAMERA = 10
"""Minimum number of images of a camera for refining its principal point."""


@dataclass(frozen=True)
class Model:
    """A reconstruction in COLMAP's conventions: world to camera, y down."""

    cameras: dict[int, tuple[str, int, int, list[float]]]
    """Lens model, width, height and parameters by camera number."""
    images: dict[str, tuple[int, int, np.ndarray]]
    """Image number, camera number and (3, 4) world-to-camera matrix by the image's name."""
    points: np.ndarray
    """(K, 3) float64 positions of sparse points."""
    colors: np.ndarray
    """(K, 3) uint8 colours of sparse points."""
    error: float
    """Mean reprojection error, pixels."""


def require() -> None:
    """Check that pycolmap is installed.

    Raises:
        DataError: if it is not, with the command that installs it.
    """
    if find_spec("pycolmap") is None:
        raise DataError("estimating camera poses needs COLMAP: pip install pycolmap")


def extract(
    report: Report,
    database: Path,
    images: Path,
    groups: list[tuple[list[str], int | None, str]],
    masks: Path | None,
    flags: ColmapFlags,
) -> None:
    """Extract features. COLMAP adds each image to the database when its features are found.

    Args:
        report: called only at the beginning, because COLMAP does not report progress.
        database: COLMAP's database; it is created if missing.
        images: folder of the images.
        groups: for each camera, the names of its images, its number if it is in the database, and its parameters in
            COLMAP's form if they are known, otherwise "".
        masks: folder of masks, or None.
        flags: the user's flags.
    """
    import pycolmap

    report(0)
    sift = _extraction_options(pycolmap)
    _set(sift, "max_image_size", flags.max_image_size)
    _set(sift, "max_num_features", flags.max_num_features)
    _set(sift, "num_threads", flags.num_threads)
    usage = pycolmap.extract_features.__doc__ or ""
    names = "image_names" if "image_names:" in usage else "image_list"  # before 3.12
    options = "extraction_options" if "extraction_options:" in usage else "sift_options"  # before 3.13
    more = {"camera_model": flags.camera_model} if "camera_model:" in usage else {}  # before 4
    for group, camera, parameters in groups:
        reader = pycolmap.ImageReaderOptions()
        _set(reader, "camera_model", flags.camera_model)
        reader.camera_params = parameters
        if masks is not None:
            reader.mask_path = str(masks)
        if camera is not None:
            reader.existing_camera_id = camera
        pycolmap.extract_features(
            str(database),
            str(images),
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            device=_device(pycolmap, flags),
            **{names: group, options: sift},
            **more,
        )


def match_pairs(
    report: Report, database: Path, pairs: list[tuple[str, str]], list_path: Path, everything: bool, flags: ColmapFlags
) -> None:
    """Match features of pairs of images in parts; COLMAP adds each finished part to the database.

    Args:
        report: called with the number of pairs done.
        database: COLMAP's database with features.
        pairs: pairs of names.
        list_path: file for the list of pairs.
        everything: whether these are all possible pairs.
        flags: the user's flags.
    """
    import pycolmap

    report(0)
    usage = pycolmap.match_exhaustive.__doc__ or ""
    if "pairing_options:" in usage:
        name, options = "matching_options", pycolmap.FeatureMatchingOptions()
    else:  # before 3.13
        name, options = "sift_options", pycolmap.SiftMatchingOptions()
    _set(options, "num_threads", flags.num_threads)
    settings = {name: options, "device": _device(pycolmap, flags)}
    if everything and not hasattr(pycolmap, "match_image_pairs"):  # before 4
        pycolmap.match_exhaustive(str(database), **settings)
        return
    done, size = 0, FIRST_PAIRS
    while done < len(pairs):
        part, start = pairs[done : done + size], time.perf_counter()
        list_path.write_text("".join(f"{first} {second}\n" for first, second in part), encoding="utf-8")
        if hasattr(pycolmap, "match_image_pairs"):
            pairing = pycolmap.ImportedPairingOptions()
            pairing.match_list_path = str(list_path)
            pycolmap.match_image_pairs(str(database), pairing_options=pairing, **settings)
        else:
            write_matches(database, part)
            pycolmap.verify_matches(str(database), str(list_path))
        done += len(part)
        report(done)
        size = round(min(max(SECONDS_OF_A_PART / (time.perf_counter() - start) * len(part), FIRST_PAIRS), MAX_PAIRS))


def reconstruct(report: Report, database: Path, images: Path, output: Path, flags: ColmapFlags) -> list[int]:
    """Estimate poses incrementally, and write the models to output/0, output/1, ..., largest first.

    Args:
        report: called with the number of registered images.
        database: COLMAP's database with matches.
        images: folder of the images.
        output: folder of the models.
        flags: the user's flags.

    Returns:
        The number of registered images of each model; empty if there is none.
    """
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = flags.num_threads
    options.min_model_size = 3
    # The lens of views is known exactly. COLMAP takes both values for single images, too.
    options.ba_refine_focal_length = options.ba_refine_extra_params = flags.camera_type == "perspective"
    registered = 0

    def count_image(pair: bool = False) -> None:
        nonlocal registered
        registered += 2 if pair else 1
        report(registered)

    raw = output.with_name(output.name + "_raw")
    raw.mkdir(parents=True)
    models = pycolmap.incremental_mapping(
        str(database),
        str(images),
        str(raw),
        options=options,
        initial_image_pair_callback=lambda: count_image(pair=True),
        next_image_callback=count_image,
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
    """Write the registered images without distortion to output/images, and their model to output/sparse.

    Args:
        report: unused.
        model: folder of the model.
        images: folder of the images.
        output: folder to write to.
    """
    import pycolmap

    pycolmap.undistort_images(str(output), str(model), str(images), output_type="COLMAP")


def read_model(report: Report, folder: Path) -> Model:
    """Read a model from a `folder` with cameras.bin, images.bin and points3D.bin; `report` is unused.

    Raises:
        DataError: if the folder has no readable model.
    """
    import pycolmap

    try:
        model = pycolmap.Reconstruction(str(folder))
    except Exception as error:  # pycolmap raises ValueError, RuntimeError and more
        raise DataError(f"{folder} has no readable COLMAP model") from error
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
    """Run a bundle adjustment with free principal points, if all cameras have enough images to determine them."""
    camera_ids = [model.images[number].camera_id for number in model.reg_image_ids()]
    if min(camera_ids.count(camera) for camera in set(camera_ids)) < MIN_IMAGES_OF_CAMERA:
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
    """Set an option; newer versions keep it in `options.sift`."""
    setattr(options if hasattr(options, name) else options.sift, name, value)


def _device(pycolmap: Any, flags: ColmapFlags) -> Any:
    if flags.device_type == "cuda" and not pycolmap.has_cuda:
        raise DataError("--device-type cuda: pycolmap was built without CUDA; leave out the flag")
    return getattr(pycolmap.Device, flags.device_type)


def _lens(camera: Any) -> str:
    name = getattr(camera, "model_name", None)
    return str(name if name is not None else camera.model.name)

"""Kinds of input of `ns-process-data` and `nerfloom.process`, and the way from each to a data folder."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from nerfloom.base.console import say
from nerfloom.base.errors import DataError
from nerfloom.base.signals import Stopped, signal_of
from nerfloom.processing.settings import (
    AriaFlags,
    BundlerFlags,
    ColmapFlags,
    ImagesFlags,
    MetashapeFlags,
    OdmFlags,
    OutputFlags,
    PolycamFlags,
    ProgramFlags,
    RealityCaptureFlags,
    Record3DFlags,
    RecordingFlags,
    VideoFlags,
)

if TYPE_CHECKING:
    from nerfloom.downloads.unpack import Place
    from nerfloom.processing.capture import Capture
    from nerfloom.processing.named_images import PlacedImages
    from nerfloom.processing.reconstruction import Reconstruction


class Kind(NamedTuple):
    """A kind of input."""

    flags: type[OutputFlags]
    """Class of its flags."""
    write: Callable[[Any], None]
    """Function of the flags that writes the data folder."""


def process(name: str, flags: OutputFlags) -> None:
    """Write the data folder of an input of the kind `name`, a key of `KINDS`, by the `flags` of that kind.

    Raises:
        ConfigError: if a flag is out of range, or COLMAP is missing.
        DataError: if the input cannot be used.
        Stopped: if a signal ends it; the message says how to continue.
    """
    flags.check()
    try:
        _check_input(flags)
        KINDS[name].write(flags)
    except KeyboardInterrupt as stop:
        kept = "--resume continues with the features and matches so far, " if flags.can_resume else ""
        note = f"interrupted; {flags.output_dir} is unfinished; {kept}--overwrite starts again"
        raise Stopped(signal_of(stop), note) from None


def _check_input(flags: OutputFlags) -> None:
    from nerfloom.processing.output import check_apart

    if not flags.data.exists():
        raise DataError(f"--data {flags.data}: there is no such file or folder")
    check_apart(flags.output_dir, flags.data)


def _is_finished(flags: ColmapFlags) -> bool:
    """Return whether a run with finished poses is resumed; write the masks that it lacks.

    Raises:
        ConfigError: if COLMAP is missing.
    """
    from nerfloom.processing import colmap
    from nerfloom.processing.output import FINISHED, lacks_masks, ready

    colmap.require()
    if not flags.resume or not (flags.output_dir / FINISHED).exists():
        return False
    if lacks_masks(flags):
        from nerfloom.processing.moving_masks import mask_moving  # imports all that trains

        mask_moving(flags.output_dir, flags.num_downscales, max_seconds=flags.mask_seconds)
        say(ready(flags.output_dir))
    else:
        say(f"nothing to resume: it is finished. {ready(flags.output_dir)}")
    return True


def _process_images(flags: ImagesFlags) -> None:
    from nerfloom.processing.listing import find_images
    from nerfloom.processing.output import begin
    from nerfloom.processing.pipeline import process as reconstruct
    from nerfloom.processing.reconstruction import Reconstruction
    from nerfloom.processing.sequence import is_sequence

    if _is_finished(flags):
        return
    sources = find_images(flags.data, [flags.output_dir, *([] if flags.masks_dir is None else [flags.masks_dir])])
    begin(flags, sources)
    state = Reconstruction(_with_lens(flags), ordered=is_sequence(sources))
    reconstruct(state, *_as_views(state, flags.data, sources), flags.masks_dir)


def _process_video(flags: VideoFlags) -> None:
    from nerfloom.processing.ffmpeg import frame_count
    from nerfloom.processing.output import begin
    from nerfloom.processing.pipeline import process as reconstruct
    from nerfloom.processing.reconstruction import Reconstruction
    from nerfloom.processing.unfinished import frames_of

    if _is_finished(flags):
        return
    frame_count(flags.data)  # before anything is removed, check that the video can be read
    begin(flags, [Path(flags.data.name)])
    state = Reconstruction(_with_lens(flags), ordered=True)
    with state.timed("reading the video"):
        folder, sources = frames_of(flags.output_dir, flags.data, flags.num_frames_target)
    reconstruct(state, *_as_views(state, folder, sources), None)


def _with_lens(flags: ColmapFlags) -> ColmapFlags:
    """Return the flags with the camera model of the images: views of panoramas have no distortion."""
    return flags if flags.camera_type == "perspective" else dataclasses.replace(flags, camera_model="PINHOLE")


def _as_views(state: Reconstruction, folder: Path, sources: list[Path]) -> tuple[Path, list[Path]]:
    """Return folder and paths of the images to reconstruct: the same ones, or the views of panoramas."""
    if state.flags.camera_type == "perspective":
        return folder, sources
    from nerfloom.processing.panoramas import write_views
    from nerfloom.processing.views import Views

    flags = state.flags
    with state.timed("cutting views"):
        return write_views(
            folder, sources, state.work, Views(flags.num_views, flags.view_angle, flags.views_up_and_down)
        )


def _convert_polycam(flags: PolycamFlags) -> None:
    from nerfloom.processing import polycam
    from nerfloom.processing.named_images import images_as_named
    from nerfloom.processing.posed_folder import write_capture

    needs = "keyframes/images and keyframes/cameras; export Polycam's raw data"
    with _export(flags, polycam.place, polycam.folders_of, needs) as export:
        images, cameras = polycam.folders_of(export)
        capture = polycam.read_capture(images, cameras, flags.most, flags.min_blur_score)
        placed, crop = images_as_named(capture), flags.crop_border_pixels
        write_capture(images, capture, placed, flags.output_dir, flags.num_downscales, crop=crop)


def _convert_record3d(flags: Record3DFlags) -> None:
    from nerfloom.processing import record3d
    from nerfloom.processing.archives import check_archive, unpacked
    from nerfloom.processing.named_images import images_as_named
    from nerfloom.processing.point_files import with_points
    from nerfloom.processing.posed_folder import write_capture

    needs = "rgbd and metadata, which recordings of Record3D (.r3d) have"
    archive = None if flags.ply is None or flags.ply.suffix.lower() != ".zip" else flags.ply
    if archive is not None:
        check_archive(archive, record3d.place_points, "PLY file; export 'Zipped sequence of PLY point clouds'")
    with _export(flags, record3d.place, record3d.find_root, needs) as export, ExitStack() as opened:
        root, points = record3d.find_root(export), flags.ply
        if archive is not None:
            points = opened.enter_context(unpacked(archive, flags.output_dir, record3d.place_points, "unpacked points"))
        capture = with_points(record3d.read_capture(root, flags.most), points)
        write_capture(root / "rgb", capture, images_as_named(capture), flags.output_dir, flags.num_downscales)


@contextmanager
def _export(flags: RecordingFlags, place: Place, find: Callable[[Path], object], needs: str) -> Iterator[Path]:
    """Claim the output folder, and yield the folder of an app's export, unpacked within a `with` block.

    Args:
        flags: flags with the export, which is a folder or a zip file.
        place: as in `unpack`.
        find: checks that a folder is an export.
        needs: the files that an archive must have, for messages.
    """
    from nerfloom.processing.archives import check_archive, unpacked
    from nerfloom.processing.output import claim

    if flags.data.is_file():
        check_archive(flags.data, place, needs)
    else:
        find(flags.data)
    claim(flags.output_dir, flags.data, flags.overwrite)
    with unpacked(flags.data, flags.output_dir, place) as export:
        yield export


def _convert_metashape(flags: MetashapeFlags) -> None:
    from nerfloom.processing.metashape import read_capture
    from nerfloom.processing.point_files import with_points

    _convert(flags, flags.data, with_points(read_capture(flags.xml), flags.ply))


def _convert_realitycapture(flags: RealityCaptureFlags) -> None:
    from nerfloom.processing.point_files import with_points
    from nerfloom.processing.realitycapture import read_capture

    _convert(flags, flags.data, with_points(read_capture(flags.csv), flags.ply))


def _convert_odm(flags: OdmFlags) -> None:
    from nerfloom.processing.opensfm import find_reconstruction, read_capture

    default = flags.data / "images" if (flags.data / "images").is_dir() else flags.data
    _convert(flags, flags.images_dir or default, read_capture(find_reconstruction(flags.data)))


def _convert_bundler(flags: BundlerFlags) -> None:
    from nerfloom.processing.bundler import find_list, read_capture

    _convert(flags, flags.data, read_capture(flags.bundle, flags.image_list or find_list(flags.bundle)))


def _convert_aria(flags: AriaFlags) -> None:
    from nerfloom.processing.aria import read_capture
    from nerfloom.processing.named_images import images_as_named

    capture = read_capture(flags.data, flags.mps_data_dir, flags.most)
    _convert(flags, flags.data, capture, images_as_named(capture))


def _convert(flags: ProgramFlags, images: Path, capture: Capture, placed: PlacedImages | None = None) -> None:
    """Write the data folder of a capture; its images are found by their names, if they are not `placed`."""
    from nerfloom.processing.named_images import placed_images
    from nerfloom.processing.output import check_apart, claim
    from nerfloom.processing.posed_folder import write_capture
    from nerfloom.processing.views import Views

    if not images.is_dir():
        raise DataError(f"{images} is not a folder; it must be that of the photographs")
    check_apart(flags.output_dir, images)
    placed = placed or placed_images(images, capture)
    claim(flags.output_dir, flags.data, flags.overwrite)
    views = Views(flags.num_views, flags.view_angle, flags.views_up_and_down)
    whole = flags.panoramas == "whole"
    write_capture(images, capture, placed, flags.output_dir, flags.num_downscales, views, whole)


KINDS: dict[str, Kind] = {
    "images": Kind(ImagesFlags, _process_images),
    "video": Kind(VideoFlags, _process_video),
    "polycam": Kind(PolycamFlags, _convert_polycam),
    "record3d": Kind(Record3DFlags, _convert_record3d),
    "metashape": Kind(MetashapeFlags, _convert_metashape),
    "realitycapture": Kind(RealityCaptureFlags, _convert_realitycapture),
    "odm": Kind(OdmFlags, _convert_odm),
    "bundler": Kind(BundlerFlags, _convert_bundler),
    "aria": Kind(AriaFlags, _convert_aria),
}
"""Kinds of input by name."""

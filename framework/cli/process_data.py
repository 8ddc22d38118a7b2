"""The command `ns-process-data`: conversion of images, a video, or a capture with poses to a data folder."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_type_hints

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError, DataError, FlagError
from nerfloom.base.signals import Stopped, signal_of
from nerfloom.cli.common import chosen_kind, run_command
from nerfloom.cli.flags import read_flags
from nerfloom.cli.process_programs import PROGRAMS
from nerfloom.processing.settings import ColmapFlags, OutputFlags

if TYPE_CHECKING:
    from nerfloom.processing.reconstruction import Reconstruction

USAGE = """\
usage: ns-process-data KIND --data IN --output-dir OUT [flags]

kinds:
  images          a folder of images; COLMAP estimates their poses
  video           a video; COLMAP estimates the poses of its sharpest frames
                  (either kind accepts the other's input, and says so)
  polycam         Polycam's raw export, a folder or a zip file, with the phone's poses
  record3d        Record3D's export with EXR and RGBD, or a recording (.r3d), with the phone's poses
  metashape       photographs with the cameras of Agisoft Metashape (XML)
  realitycapture  photographs with the cameras of RealityCapture or RealityScan (CSV)
  odm             a project of OpenDroneMap or OpenSfM
  bundler         photographs with the cameras of Bundler (bundle.out), which many programs write

ns-process-data KIND --help shows its flags.
"""


@dataclass(frozen=True, kw_only=True)
class ImagesFlags(ColmapFlags):
    """Estimate the poses of the images in a folder and its subfolders."""

    masks_dir: Path | None = None
    """Folder of masks with the images' names; black pixels are ignored for poses and training."""

    def check(self) -> None:
        super().check()
        if self.masks_dir is not None and self.undistort:
            raise ConfigError("--masks-dir with --undistort: masks are not undistorted; leave one of them out")
        if self.masks_dir is not None and self.mask_moving:
            raise ConfigError("--masks-dir with --mask-moving: an image has one mask; leave one of them out")
        if self.masks_dir is not None and self.camera_type == "equirectangular":
            raise ConfigError("--masks-dir with --camera-type equirectangular: masks are not cut; leave out one")
        if self.masks_dir is not None and not self.masks_dir.is_dir():
            raise ConfigError(f"--masks-dir {self.masks_dir}: there is no such folder")


@dataclass(frozen=True, kw_only=True)
class VideoFlags(ColmapFlags):
    """Estimate the poses of the sharpest frames of a video."""

    num_frames_target: int = 300
    """Number of frames to take. The video is split into this many equal intervals; each gives its sharpest frame."""

    def check(self) -> None:
        super().check()
        if self.num_frames_target < 3:
            raise FlagError(f"--num-frames-target is {self.num_frames_target}; it must be at least 3")


@dataclass(frozen=True, kw_only=True)
class PhoneFlags(OutputFlags):
    """Flags of captures with poses."""

    max_dataset_size: int = 300
    """Maximum number of images to take, evenly spaced; -1 for all."""

    def check(self) -> None:
        super().check()
        if self.max_dataset_size < 2 and self.max_dataset_size != -1:
            raise FlagError(f"--max-dataset-size is {self.max_dataset_size}; it must be at least 2, or -1 for all")

    @property
    def most(self) -> int:
        """Maximum number of images to take."""
        return sys.maxsize if self.max_dataset_size == -1 else self.max_dataset_size


@dataclass(frozen=True, kw_only=True)
class PolycamFlags(PhoneFlags):
    """Convert Polycam's raw export."""

    min_blur_score: float = 25.0
    """Minimum score of sharpness, from Polycam; images with a lower score are omitted."""
    crop_border_pixels: int = 15
    """Pixels to crop at each side, since Polycam's images may have a black border."""

    def check(self) -> None:
        super().check()
        if self.crop_border_pixels < 0:
            raise FlagError(f"--crop-border-pixels is {self.crop_border_pixels}; it must be at least 0")


@dataclass(frozen=True, kw_only=True)
class Record3DFlags(PhoneFlags):
    """Convert Record3D's export with EXR and RGBD."""


def main() -> None:
    """Run ns-process-data on the arguments of the process."""
    run_command(_command)


def _command(arguments: list[str]) -> None:
    if (chosen := chosen_kind(arguments, KINDS, USAGE, "unknown kind")) is None:
        return
    name, (kind, process), rest = chosen
    words = _spelt_out(rest, kind)
    if (other := _what_it_is(name, words)) is not None:
        name, words = other
        kind, process = KINDS[name]
    flags = read_flags(kind, f"ns-process-data {name}", words)
    flags.check()
    try:
        _check_input(flags)
        process(flags)
    except KeyboardInterrupt as stop:
        kept = "--resume continues with the features and matches so far, " if flags.can_resume else ""
        note = f"interrupted; {flags.output_dir} is unfinished; {kept}--overwrite starts again"
        raise Stopped(signal_of(stop), note) from None


def _what_it_is(name: str, words: list[str]) -> tuple[str, list[str]] | None:
    """Return the other kind and its arguments if the kind is images and --data a video, or the reverse.

    A folder with one video and no images counts as the video.
    """
    words = [part for word in words for part in (word.split("=", 1) if word.startswith("--data=") else [word])]
    given = [index for index, word in enumerate(words[:-1]) if word == "--data"]
    if name not in ("images", "video") or not given:
        return None
    from nerfloom.processing.listing import kind_of

    kind, data = kind_of(name, Path(words[given[-1] + 1]))
    return None if kind == name else (kind, [*words[: given[-1] + 1], str(data), *words[given[-1] + 2 :]])


def _spelt_out(arguments: list[str], kind: type[OutputFlags]) -> list[str]:
    """Return the arguments with `--overwrite` alone spelt out as `--overwrite True`."""
    hints = get_type_hints(kind)
    switches = {f.name for f in dataclasses.fields(kind) if hints[f.name] is bool}
    words = []
    for index, word in enumerate(arguments):
        words.append(word)
        last = index + 1 == len(arguments)
        if word[2:].replace("-", "_") in switches and (last or arguments[index + 1] not in ("True", "False")):
            words.append("True")
    return words


def _check_input(flags: OutputFlags) -> None:
    from nerfloom.processing.output import check_apart

    if not flags.data.exists():
        raise DataError(f"--data {flags.data}: there is no such file or folder")
    check_apart(flags.output_dir, flags.data)


def _is_finished(flags: ColmapFlags) -> bool:
    """Return whether a run is resumed whose poses are finished; write the masks that it lacks.

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
    from nerfloom.processing.pipeline import process
    from nerfloom.processing.reconstruction import Reconstruction
    from nerfloom.processing.sequence import is_sequence

    if _is_finished(flags):
        return
    sources = find_images(flags.data, [flags.output_dir, *([] if flags.masks_dir is None else [flags.masks_dir])])
    begin(flags, sources)
    state = Reconstruction(_with_lens(flags), ordered=is_sequence(sources))
    process(state, *_as_views(state, flags.data, sources), flags.masks_dir)


def _process_video(flags: VideoFlags) -> None:
    from nerfloom.processing.ffmpeg import frame_count
    from nerfloom.processing.output import begin
    from nerfloom.processing.pipeline import process
    from nerfloom.processing.reconstruction import Reconstruction
    from nerfloom.processing.unfinished import frames_of

    if _is_finished(flags):
        return
    frame_count(flags.data)  # before anything is removed, check that the video can be read
    begin(flags, [Path(flags.data.name)])
    state = Reconstruction(_with_lens(flags), ordered=True)
    with state.timed("reading the video"):
        folder, sources = frames_of(flags.output_dir, flags.data, flags.num_frames_target)
    process(state, *_as_views(state, folder, sources), None)


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
    from nerfloom.processing.archives import check_archive, unpacked
    from nerfloom.processing.output import claim
    from nerfloom.processing.polycam import check, convert, place

    if flags.data.is_file():
        check_archive(flags.data, place, "keyframes/images and keyframes/cameras; export Polycam's raw data")
    else:
        check(flags.data)
    claim(flags.output_dir, flags.data, flags.overwrite)
    crop = flags.crop_border_pixels
    with unpacked(flags.data, flags.output_dir, place) as export:
        convert(export, flags.output_dir, flags.num_downscales, flags.most, flags.min_blur_score, crop)


def _convert_record3d(flags: Record3DFlags) -> None:
    from nerfloom.processing.archives import check_archive, unpacked
    from nerfloom.processing.output import claim
    from nerfloom.processing.record3d import convert, find_root, place

    if flags.data.is_file():
        check_archive(flags.data, place, "rgbd and metadata, which recordings of Record3D (.r3d) have")
    else:
        find_root(flags.data)
    claim(flags.output_dir, flags.data, flags.overwrite)
    with unpacked(flags.data, flags.output_dir, place) as export:
        convert(export, flags.output_dir, flags.num_downscales, flags.most)


KINDS: dict[str, tuple[type[OutputFlags], Callable[[Any], None]]] = {
    "images": (ImagesFlags, _process_images),
    "video": (VideoFlags, _process_video),
    "polycam": (PolycamFlags, _convert_polycam),
    "record3d": (Record3DFlags, _convert_record3d),
    **PROGRAMS,
}


if __name__ == "__main__":
    main()

"""Kinds of input, and the way from each to a data folder: what `ns-process-data` and `nerfloom.process` take."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from nerfloom.base.console import say
from nerfloom.base.errors import DataError
from nerfloom.base.signals import Stopped, signal_of
from nerfloom.processing.settings import (
    ColmapFlags,
    ImagesFlags,
    OutputFlags,
    PolycamFlags,
    Record3DFlags,
    VideoFlags,
)


class Kind(NamedTuple):
    """A kind of input."""

    flags: type[OutputFlags]
    """Class of its flags."""
    write: Callable[[Any], None]
    """Function of the flags that writes the data folder."""


def process(name: str, flags: OutputFlags) -> None:
    """Write the data folder of an input.

    Args:
        name: the kind of input, a key of `KINDS`.
        flags: flags of that kind.

    Raises:
        ConfigError: if a flag is out of range, or COLMAP is missing.
        DataError: if the input cannot be used.
        Stopped: if a signal ends it; the message says how to go on.
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
    from nerfloom.processing.pipeline import process as reconstruct
    from nerfloom.processing.reconstruction import Reconstruction
    from nerfloom.processing.sequence import is_sequence

    if _is_finished(flags):
        return
    sources = find_images(flags.data, [flags.output_dir, *([] if flags.masks_dir is None else [flags.masks_dir])])
    begin(flags, sources)
    reconstruct(Reconstruction(flags, ordered=is_sequence(sources)), flags.data, sources, flags.masks_dir)


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
    state = Reconstruction(flags, ordered=True)
    with state.timed("reading the video"):
        folder, sources = frames_of(flags.output_dir, flags.data, flags.num_frames_target)
    reconstruct(state, folder, sources, None)


def _convert_polycam(flags: PolycamFlags) -> None:
    from nerfloom.processing.output import claim
    from nerfloom.processing.polycam import check, convert

    check(flags.data)
    claim(flags.output_dir, flags.data, flags.overwrite)
    crop = flags.crop_border_pixels
    convert(flags.data, flags.output_dir, flags.num_downscales, flags.most, flags.min_blur_score, crop)


def _convert_record3d(flags: Record3DFlags) -> None:
    from nerfloom.processing.output import claim
    from nerfloom.processing.record3d import convert, find_root

    find_root(flags.data)
    claim(flags.output_dir, flags.data, flags.overwrite)
    convert(flags.data, flags.output_dir, flags.num_downscales, flags.most)


KINDS: dict[str, Kind] = {
    "images": Kind(ImagesFlags, _process_images),
    "video": Kind(VideoFlags, _process_video),
    "polycam": Kind(PolycamFlags, _convert_polycam),
    "record3d": Kind(Record3DFlags, _convert_record3d),
}
"""Kinds of input by name."""

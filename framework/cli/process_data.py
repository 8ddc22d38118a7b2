"""The command `ns-process-data`: conversion of images, a video, or a capture with poses to a data folder."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import get_type_hints

from nerfloom.cli.common import chosen_kind, entry_point
from nerfloom.cli.flags import read_flags
from nerfloom.processing.kinds import KINDS, process
from nerfloom.processing.settings import OutputFlags

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
  aria            images of Project Aria glasses with the trajectory that MPS has found

ns-process-data KIND --help shows its flags.
"""


@entry_point
def main(arguments: list[str]) -> None:
    """Run ns-process-data on the `arguments` of the process."""
    name, (kind, _), rest = chosen_kind(arguments, KINDS, USAGE, "unknown kind")
    words = _spelt_out(rest, kind)
    if (other := _what_it_is(name, words)) is not None:
        name, words = other
    flags = read_flags(KINDS[name].flags, f"ns-process-data {name}", words)
    process(name, flags)


def _what_it_is(name: str, words: list[str]) -> tuple[str, list[str]] | None:
    """Return the other kind and its arguments if the kind is images and --data a video, or the reverse.

    A folder with one video and no images counts as the video.
    """
    words = [part for word in words for part in (word.split("=", 1) if word.startswith("--data=") else [word])]
    given = [index for index, word in enumerate(words[:-1]) if word == "--data"]
    if not given:
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


if __name__ == "__main__":
    main()

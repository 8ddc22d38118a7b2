"""Cameras of a run as files: nerfstudio's transforms.json, COLMAP's text model, and a list of the training cameras."""

from __future__ import annotations

import shlex
from pathlib import Path

from nerfloom.base.console import say
from nerfloom.base.counts import counted
from nerfloom.base.errors import ConfigError, DataError
from nerfloom.base.json_files import write_json
from nerfloom.data.parsed_scene import ParsedScene
from nerfloom.export.cameras import SPLITS, camera_list, posed_files
from nerfloom.export.colmap_text import images_folder, write_model
from nerfloom.export.settings import CameraSettings
from nerfloom.export.transforms import write_transforms
from nerfloom.training.loaded import Loaded


def export_cameras(loaded: Loaded, path: Path, settings: CameraSettings) -> None:
    """Write the cameras of all photographs, refined if the run refined them, and say where they are.

    Beside the file are nerfstudio/transforms.json and colmap/sparse/0.

    Args:
        loaded: the run, or a file with photographs.
        path: JSON file of the training cameras to write.
        settings: settings of the cameras.

    Raises:
        ConfigError: for a file without photographs.
        DataError: if they cannot be read.
    """
    # Load the images too: cameras of unreadable images are not in the model.
    dataset = loaded.dataset("train")
    write_json(path, camera_list(dataset.cameras, dataset.names, loaded.placement))
    say(f"{len(dataset)} training cameras: {path}")
    scenes: dict[str, ParsedScene] = {}
    for split in SPLITS:
        try:
            scenes[split] = loaded.parsed(split)
        except DataError as error:
            say(f"no '{split}' cameras: {error}")
    posed = posed_files(scenes, loaded.placement)
    file = path.parent / "nerfstudio" / "transforms.json"
    write_transforms(file, posed, settings.relative_paths)
    counts = ", ".join(f"{len(members)} {split}" for split, members in posed.splits.items())
    folder = shlex.quote(str(file.parent))
    say(f"{counted(len(posed.files), 'cameras')} ({counts}): {file}; train on it: ns-train METHOD --data {folder}")
    model = path.parent / "colmap" / "sparse" / "0"
    try:
        write_model(model, posed)
    except ConfigError as error:
        say(f"no COLMAP model: {error}")
    else:
        say(f"COLMAP model: {model}; its images are in {images_folder(posed)}")

"""Rendering along a path, to a video, an animation, or a folder of images."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch

from nerfloom.base.console import say, track
from nerfloom.base.errors import ConfigError
from nerfloom.base.plain import to_plain
from nerfloom.cameras.view import View
from nerfloom.evaluation.error_bound import limited_error, parse_error
from nerfloom.evaluation.frames import FACTS, Frames, hash_of_file, hash_of_tensors, open_frames, write_file
from nerfloom.evaluation.outputs import (
    Arrays,
    chosen_outputs,
    distance_range,
    largest_distance,
    opaque_distance,
    rendered_outputs,
    shown_output,
    side_by_side,
)
from nerfloom.evaluation.video_suffixes import MAX_GIF_FPS, VIDEO, check_suffix
from nerfloom.evaluation.videos import MAX_UINT16, write_distances, write_images, write_strip, write_video
from nerfloom.rendering.outputs import Output
from nerfloom.splats.gaussians import HasGaussians
from nerfloom.training.loaded import Loaded
from nerfloom.video.film import part_length, render_film
from nerfloom.video.settings import FileSettings, PathSettings, ViewSettings
from nerfloom.video.views import VIEWS, Views, background_of

NUMBERS = ("distance", "scalar")
"""Kinds of outputs shown with a colour map."""


def render_path(loaded: Loaded, name: str, output: Path, settings: PathSettings) -> None:
    """Render views along a path, write the files, and print their paths.

    Frames are kept beside the output until it is complete, so that a stopped render can continue.

    Args:
        loaded: the run or file to render.
        name: name of the path, a key of `PATHS`.
        output: file, with the format as suffix (.mp4, .gif, .webp, .png), or a folder of images.
        settings: settings of the path.

    Raises:
        ConfigError: if a setting is out of range, the path does not suit the run, or a file cannot be written.
        DataError: if data that the path needs cannot be read.
    """
    settings.check(output)
    check_suffix(output)
    target = settings.target(output)
    model, is_folder = loaded.model, not target.suffix
    if settings.rays_per_pixel is not None and isinstance(model, HasGaussians):
        raise ConfigError("--rays-per-pixel has no effect with Gaussians: leave it out")
    bound = None if settings.max_error is None else parse_error(settings.max_error)
    outputs = chosen_outputs(model, settings.rendered_output_names)
    views, background = _views(name, settings, loaded, output), background_of(settings, loaded)
    facts = _facts(name, settings, loaded, views)
    if is_folder:
        _check_folder(target, facts)

    def render(index: int) -> Any:
        view = View.of(views.cameras, index, views.times)
        if settings.rays_per_pixel is not None:
            view = dataclasses.replace(view, rays_per_pixel=settings.rays_per_pixel)
        truth = None if views.truth is None else views.truth(index)
        return rendered_outputs(model, view, background, outputs, loaded.unit, truth)

    film, count = _is_film(settings, target, outputs), len(views.cameras)
    area = int(views.cameras.widths[0]) * int(views.cameras.heights[0])
    frames = open_frames(target, count, facts, part_length(3 * area * len(outputs)) if film else None)
    with nullcontext() if bound is None else limited_error(model, bound):
        if film:
            render_film(frames, render, partial(_picture, names=[each.name for each in outputs]), target, views.fps)
        else:
            frames.render(render)
    if bound is not None:
        say(f"--max-error: rays ended where the rest could change a colour by at most {bound:.2g}")
    if film:
        say(f"{count} frames ({', '.join(each.name for each in outputs)}): {target}")
    else:
        _write(settings, frames, target, views, facts, outputs, loaded.scale.unit or "units of the input")
    frames.remove()


def _views(name: str, settings: PathSettings, loaded: Loaded, output: Path) -> Views:
    """Return the views to render, at their final size."""
    views = VIEWS[name](settings, loaded)
    sizes = torch.stack([views.cameras.widths, views.cameras.heights])
    if int(sizes.min()) < 1:
        raise ConfigError(f"--downscale-factor {settings.downscale_factor} leaves no pixel")
    if output.suffix and bool((sizes != sizes[:, :1]).any()):
        raise ConfigError(f"--output-path {output}: the images are of several sizes; name a folder")
    if output.suffix.lower() == ".gif" and views.fps > MAX_GIF_FPS:
        limit = f"a GIF has at most {MAX_GIF_FPS:g} frames per second, not {views.fps:g}"
        raise ConfigError(f"--output-path {output}: {limit}; name a .webp or a .mp4, or give a smaller --fps")
    return views


def _facts(name: str, settings: PathSettings, loaded: Loaded, views: Views) -> dict[str, Any]:
    """Return everything that determines the pictures, as plain data."""
    cameras = views.cameras
    numbers = [getattr(cameras, field.name) for field in dataclasses.fields(cameras)]
    placement = loaded.placement
    facts = {
        "path": name,
        "method": loaded.method,
        "run": str(loaded.origin.resolve()),
        "checkpoint": loaded.checkpoint.name,
        "checkpoint_sha256": hash_of_file(loaded.checkpoint),
        "settings": None if loaded.source is None else to_plain(loaded.source.config),
        "placement_sha256": hash_of_tensors(placement.transform, torch.tensor(placement.scale)),
        "num_frames": len(cameras),
        "camera_model": cameras.model,
        "cameras_sha256": hash_of_tensors(*(one for one in numbers if hasattr(one, "shape")), views.times),
        "outputs": _values(settings, ViewSettings),
        "files": _values(settings, FileSettings),
    }
    return json.loads(json.dumps(facts, default=str))


def _values(settings: PathSettings, kind: type[ViewSettings] | type[FileSettings]) -> dict[str, Any]:
    """Return the settings of one kind by name."""
    return {field.name: getattr(settings, field.name) for field in dataclasses.fields(kind)}


def _check_folder(folder: Path, facts: dict[str, Any]) -> None:
    """Refuse a folder that holds the images of another render."""
    try:
        before = json.loads((folder / FACTS).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return
    except (OSError, ValueError):
        before = None
    if before != facts:
        raise ConfigError(
            f"{folder} holds images of another render ({FACTS} differs); name another folder, or remove it"
        )


def _is_film(settings: PathSettings, output: Path, outputs: Sequence[Output]) -> bool:
    """Return whether the render is one video without numbers: their colours depend on all frames."""
    is_one = len(outputs) == 1 or not settings.apart
    return output.suffix.lower() == VIDEO and is_one and not any(output.kind in NUMBERS for output in outputs)


def _picture(
    kept: Arrays, names: Sequence[str], ranges: Mapping[str, tuple[float, float]] = MappingProxyType({})
) -> np.ndarray:
    """Return the picture (H, W', 3) of the outputs `names` of a frame, side by side; `ranges` as in `shown_output`."""
    return side_by_side([shown_output(kept, name, ranges) for name in names])


# -- files --------------------------------------------------------------------------------------------------------


def _write(
    settings: PathSettings,
    frames: Frames,
    output: Path,
    views: Views,
    facts: dict[str, Any],
    outputs: Sequence[Output],
    lengths: str,
) -> None:
    """Write the requested files, and print their paths; distances are in the unit `lengths`."""
    is_folder = not output.suffix
    names = [each.name for each in outputs]
    kinds = {each.name: each.kind for each in outputs}
    stems = views.names or tuple(f"{index:05d}" for index in range(frames.count))
    if settings.depth_format != "color":
        for name in [name for name in names if kinds[name] == "distance"]:
            _write_depths(settings, frames, output / name, stems, name, lengths)
            names.remove(name)
    ranges = {
        name: _colored_range(settings, frames, name, f", in {lengths}" if kinds[name] == "distance" else None)
        for name in names
        if kinds[name] in NUMBERS
    }
    apart = settings.shows_images and is_folder if settings.apart is None else settings.apart
    for group in [[name] for name in names] if apart else [names] if names else []:
        pictures = map(partial(_picture, names=group, ranges=ranges), frames)
        shown = track(pictures, "Writing", total=frames.count)
        if is_folder:
            folder = output / group[0] if apart else output
            suffix = ".png" if settings.image_format == "png" else ".jpg"
            write_images([folder / f"{stem}{suffix}" for stem in stems], shown)
            say(f"{frames.count} images ({', '.join(group)}): {folder}")
            continue
        file = output.with_name(f"{output.stem}-{group[0]}{output.suffix}") if apart and len(names) > 1 else output
        if settings.png_is_strip and file.suffix.lower() == ".png":
            write_strip(file, shown)
        else:
            write_video(file, shown, views.fps)
        say(f"{frames.count} frames ({', '.join(group)}): {file}")
    if is_folder:
        write_file(output / FACTS, (json.dumps(facts, indent=2) + "\n").encode())


def _colored_range(settings: PathSettings, frames: Frames, name: str, unit: str | None) -> tuple[float, float]:
    """Return and print the ends of the colours of output `name` in `frames`; `settings` give the ends of distances."""
    given = settings.depth_near_plane, settings.depth_far_plane
    near, far = (None, None) if unit is None else given
    if near is None or far is None:
        found = distance_range(track(frames, "Measuring ranges", total=frames.count), name)
        near, far = found[0] if near is None else near, found[1] if far is None else far
    say(f"{name}: {near:.4g} (dark) to {far:.4g} (light){unit or ''}")
    return near, far


def _write_depths(
    settings: PathSettings, frames: Frames, folder: Path, stems: Sequence[str], name: str, lengths: str
) -> None:
    """Write distances as numbers, with depth.json, which gives their unit."""
    packed = settings.depth_format == "png16"
    farthest = settings.depth_far_plane
    if packed and farthest is None:
        farthest = largest_distance(track(frames, "Measuring distances", total=frames.count), name)
    unit = (farthest or 1.0) / MAX_UINT16 if packed else 1.0
    distances: Iterator[np.ndarray] = map(partial(opaque_distance, name=name), frames)
    suffix = ".png" if packed else ".npy"
    paths = [folder / f"{stem}{suffix}" for stem in stems]
    write_distances(paths, track(distances, "Writing", total=frames.count), unit)
    meaning = {"unit": unit, "distance": f"along the ray, in {lengths}: the file's value times 'unit'"}
    meaning |= {"unknown": 0, "saturated": MAX_UINT16} if packed else {"unknown": 0}
    write_file(folder / "depth.json", (json.dumps(meaning, indent=2) + "\n").encode())
    say(f"{frames.count} maps of {name} (values times {unit:.6g}, in {lengths}): {folder}")

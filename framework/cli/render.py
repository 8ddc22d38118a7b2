"""The command `ns-render`: images, animations and videos of a trained run, a file of Gaussians or an octree."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.base.from_nerfstudio import render_answer
from nerfloom.cli.common import chosen_kind, make_room, run_command, with_format, with_run
from nerfloom.cli.flags import read_flags
from nerfloom.cli.render_flags import PATHS, USAGE, PathFlags
from nerfloom.cli.run_flags import OPENS
from nerfloom.evaluation.video_suffixes import check_suffix

if TYPE_CHECKING:
    import numpy as np

    from nerfloom.cli.render_paths import Views
    from nerfloom.evaluation.frames import Frames
    from nerfloom.rendering.outputs import Output
    from nerfloom.training.file_data import DataFormat
    from nerfloom.training.loaded import Loaded

NUMBERS = ("distance", "scalar")
"""Kinds of outputs shown with a colour map."""


def main() -> None:
    """Run ns-render on the arguments of the process."""
    run_command(_command)


def _command(arguments: list[str]) -> None:
    if (chosen := chosen_kind(arguments, PATHS, USAGE, "unknown path")) is None:
        return
    import tyro

    name, path, rest = chosen
    if answer := next(filter(None, map(render_answer, rest)), None):
        raise FlagError(answer)
    words, named = with_format(f"ns-render {name}", with_run(rest, {"--rendered-output-names"}))
    options = (tyro.conf.FlagConversionOff, tyro.conf.OmitArgPrefixes)
    flags: Any = read_flags(path, f"ns-render {name}", words, OPENS, config=options)
    _render(name, flags, named)


def _render(name: str, flags: PathFlags, named: DataFormat | None) -> None:
    flags.check()
    check_suffix(flags.output_path)
    found = flags.run.check()
    output, is_folder = flags.folder_or_file, not flags.output_path.suffix
    make_room(output / "render.json" if is_folder else output)
    from contextlib import nullcontext

    from nerfloom.base.console import say
    from nerfloom.cameras.view import View
    from nerfloom.evaluation.error_bound import limited_error, parse_error
    from nerfloom.evaluation.frames import open_frames
    from nerfloom.evaluation.outputs import chosen_outputs, rendered_outputs

    bound = None if flags.outputs.max_error is None else parse_error(flags.outputs.max_error)
    loaded = flags.run.load(found, named, rays_per_pixel=flags.outputs.rays_per_pixel)
    model = loaded.model
    outputs = chosen_outputs(model, flags.outputs.rendered_output_names)
    views, background = _views(name, flags, loaded), model.background
    facts = _facts(name, flags, loaded, views)
    if is_folder:
        _check_folder(output, facts)

    def render(index: int) -> Any:
        view = View.of(views.cameras, index, views.times)
        truth = None if views.truth is None else views.truth(index)
        return rendered_outputs(model, view, background, outputs, loaded.unit, truth)

    with nullcontext() if bound is None else limited_error(model, bound):
        frames = open_frames(output, len(views.cameras), facts)
        frames.render(render)
    if bound is not None:
        say(f"--max-error: rays ended where the rest could change a colour by at most {bound:.2g}")
    _write(flags, frames, output, views, facts, outputs)
    frames.remove()


def _views(name: str, flags: PathFlags, loaded: Loaded) -> Views:
    """Return what is rendered, at its final size."""
    import torch

    from nerfloom.cli.render_paths import VIEWS

    views = VIEWS[name](flags, loaded)
    sizes = torch.stack([views.cameras.widths, views.cameras.heights])
    if int(sizes.min()) < 1:
        raise ConfigError(f"--downscale-factor {flags.outputs.downscale_factor} leaves no pixel")
    if flags.output_path.suffix and bool((sizes != sizes[:, :1]).any()):
        raise ConfigError(f"--output-path {flags.output_path}: the images are of several sizes; name a folder")
    return views


def _facts(name: str, flags: PathFlags, loaded: Loaded, views: Views) -> dict[str, Any]:
    """Return everything that determines the pictures, as plain data."""
    from nerfloom.base.plain import to_plain
    from nerfloom.evaluation.frames import hash_of_file, hash_of_tensors

    cameras = views.cameras
    numbers = [getattr(cameras, field.name) for field in dataclasses.fields(cameras)]
    facts = {
        "path": name,
        "method": loaded.method,
        "run": str(loaded.origin.resolve()),
        "checkpoint": loaded.checkpoint.name,
        "checkpoint_sha256": hash_of_file(loaded.checkpoint),
        "settings": None if loaded.source is None else to_plain(loaded.source.config),
        "up": flags.run.up,
        "num_frames": len(cameras),
        "camera_model": cameras.model,
        "cameras_sha256": hash_of_tensors(*(one for one in numbers if hasattr(one, "shape")), views.times),
        "outputs": dataclasses.asdict(flags.outputs),
        "files": dataclasses.asdict(flags.files),
    }
    return json.loads(json.dumps(facts, default=str))


def _check_folder(folder: Path, facts: dict[str, Any]) -> None:
    """Refuse a folder that holds the images of another render."""
    from nerfloom.evaluation.frames import FACTS

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


# -- files --------------------------------------------------------------------------------------------------------


def _write(
    flags: PathFlags, frames: Frames, output: Path, views: Views, facts: dict[str, Any], outputs: Sequence[Output]
) -> None:
    """Write the requested files, and print their paths."""
    from nerfloom.base.console import say, track
    from nerfloom.evaluation.frames import FACTS, write_file
    from nerfloom.evaluation.outputs import shown_output, side_by_side
    from nerfloom.evaluation.videos import write_images, write_strip, write_video

    is_folder = not output.suffix
    names = [each.name for each in outputs]
    kinds = {each.name: each.kind for each in outputs}
    stems = views.names or tuple(f"{index:05d}" for index in range(frames.count))
    if flags.files.depth_format != "color":
        for name in [name for name in names if kinds[name] == "distance"]:
            _write_depths(flags, frames, output / name, stems, name)
            names.remove(name)
    ranges = {name: _colored_range(flags, frames, name, kinds[name]) for name in names if kinds[name] in NUMBERS}
    apart = flags.shows_images and is_folder if flags.files.apart is None else flags.files.apart
    for group in [[name] for name in names] if apart else [names] if names else []:
        pictures = (side_by_side([shown_output(kept, name, ranges) for name in group]) for kept in frames)
        shown = track(pictures, "Writing", total=frames.count)
        if is_folder:
            folder = output / group[0] if apart else output
            suffix = ".png" if flags.files.image_format == "png" else ".jpg"
            write_images([folder / f"{stem}{suffix}" for stem in stems], shown)
            say(f"{frames.count} images ({', '.join(group)}): {folder}")
            continue
        file = output.with_name(f"{output.stem}-{group[0]}{output.suffix}") if apart and len(names) > 1 else output
        if flags.png_is_strip and file.suffix.lower() == ".png":
            write_strip(file, shown)
        else:
            write_video(file, shown, views.fps)
        say(f"{frames.count} frames ({', '.join(group)}): {file}")
    if is_folder:
        write_file(output / FACTS, (json.dumps(facts, indent=2) + "\n").encode())


def _colored_range(flags: PathFlags, frames: Frames, name: str, kind: str) -> tuple[float, float]:
    """Return and print the values at the ends of an output's colour map; flags set the range of distances."""
    from nerfloom.base.console import say, track
    from nerfloom.evaluation.outputs import distance_range

    given = flags.outputs.depth_near_plane, flags.outputs.depth_far_plane
    near, far = given if kind == "distance" else (None, None)
    if near is None or far is None:
        found = distance_range(track(frames, "Measuring ranges", total=frames.count), name)
        near, far = found[0] if near is None else near, found[1] if far is None else far
    say(f"{name}: {near:.4g} (dark) to {far:.4g} (light){', in units of the input' if kind == 'distance' else ''}")
    return near, far


def _write_depths(flags: PathFlags, frames: Frames, folder: Path, stems: Sequence[str], name: str) -> None:
    """Write distances as numbers, with depth.json, which gives their unit."""
    from nerfloom.base.console import say, track
    from nerfloom.evaluation.frames import write_file
    from nerfloom.evaluation.outputs import largest_distance, opaque_distance
    from nerfloom.evaluation.videos import MAX_UINT16, write_distances

    packed = flags.files.depth_format == "png16"
    farthest = flags.outputs.depth_far_plane
    if packed and farthest is None:
        farthest = largest_distance(track(frames, "Measuring distances", total=frames.count), name)
    unit = (farthest or 1.0) / MAX_UINT16 if packed else 1.0
    distances: Iterator[np.ndarray] = map(partial(opaque_distance, name=name), frames)
    suffix = ".png" if packed else ".npy"
    paths = [folder / f"{stem}{suffix}" for stem in stems]
    write_distances(paths, track(distances, "Writing", total=frames.count), unit)
    meaning = {"unit": unit, "distance": "along the ray, in units of the input: the file's value times 'unit'"}
    meaning |= {"unknown": 0, "saturated": MAX_UINT16} if packed else {"unknown": 0}
    write_file(folder / "depth.json", (json.dumps(meaning, indent=2) + "\n").encode())
    say(f"{frames.count} maps of {name} (unit {unit:.6g} of the input): {folder}")


if __name__ == "__main__":
    main()

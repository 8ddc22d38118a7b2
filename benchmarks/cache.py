"""Memory and speed of training with a large image set under --cache-limit, and with a small one in memory.

Renders of the embedded scene are enlarged to the given image size. instant-ngp is trained on them with their pixels in
a file, and on the same images at a quarter of the width with all pixels in memory, each in its own process. The page
cache is warm, because the file has just been written.
"""

from __future__ import annotations

import dataclasses
import json
import math
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from PIL import Image

from benchmarks.children import output_of, own_command
from nerfloom.base.console import say, track
from nerfloom.data.pixels.stream import PixelStream
from nerfloom.registry import load_dataparser, load_method
from nerfloom.training.datasets import load_split
from nerfloom.training.machine import machine
from nerfloom.training.run import Run, create_folder
from nerfloom.training.trainer import Trainer

RENDERED = 200
"""Width and height of the renders before they are enlarged, pixels."""
WARM_UP = 0.25
"""Fraction of the time before the speed is measured; the occupancy grid has then found empty space."""
SETS = (("small, in memory", 4, False), ("large, from a file", 1, True), ("again", 1, True))
"""Name of each set, divisor of width and height, and whether pixels are read from a file."""


def measure(images: int, size: tuple[int, int], seconds: float, limit: float, folder: Path | None) -> dict[str, Any]:
    """Make the images and train on each set; print a line for each.

    Args:
        images: number of images.
        size: width and height of the large images, pixels.
        seconds: seconds of training on each set.
        limit: maximum memory of decoded pixels, MB.
        folder: folder of images and cache; None for the system's temporary folder.

    Returns:
        The machine, the arguments and the result of `trained_on` for each set, as plain data.
    """
    content: dict[str, Any] = {"machine": machine(), "images": images, "size": list(size), "seconds": seconds}
    parser = load_dataparser("procedural")(size=RENDERED, num_train=images)  # type: ignore[call-arg]
    renders = parser.parse(None, "train").image_paths[0].parents[1]
    with tempfile.TemporaryDirectory(dir=folder) as name:
        for kind, divisor, cached in SETS:
            data = Path(name) / f"data-{divisor}"
            if not data.is_dir():
                enlarge(renders, data, size[0] // divisor, size[1] // divisor)
            arguments = json.dumps([str(data), name, seconds, limit if cached else None])
            output = output_of(own_command("cache", arguments))
            content[kind] = json.loads(output.splitlines()[-1])
            say(f"{kind} {json.dumps(content[kind])}")
    return content


def enlarge(source: Path, target: Path, width: int, height: int) -> None:
    """Write renders over black, enlarged to the images' height and centred, with matching cameras.

    Args:
        source: folder of a data set in the blender format, with square renders.
        target: folder to create, in the same format.
        width: width of the images, pixels.
        height: height of the images, pixels.
    """
    (target / "train").mkdir(parents=True)
    content = json.loads((source / "transforms_train.json").read_text())
    half = math.tan(content["camera_angle_x"] / 2) * width / height
    content["camera_angle_x"] = 2 * math.atan(half)
    for frame in track(content["frames"], "Enlarging", total=len(content["frames"])):
        render = Image.open(source / f"{frame['file_path']}.png").convert("RGBA")
        black = Image.new("RGBA", render.size, (0, 0, 0, 255))
        large = Image.alpha_composite(black, render).convert("RGB").resize((height, height), Image.Resampling.BICUBIC)
        image = Image.new("RGB", (width, height))
        image.paste(large, ((width - height) // 2, 0))
        frame["file_path"] = f"./train/{Path(frame['file_path']).name}.jpg"
        image.save(target / frame["file_path"], quality=95)
    (target / "transforms_train.json").write_text(json.dumps(content))


def trained_on(data: Path, folder: Path, seconds: float, limit: float | None) -> dict[str, Any]:
    """Load a data set and train on it.

    Args:
        data: folder of the data set, in the blender format.
        folder: folder of the cache.
        seconds: seconds of training.
        limit: maximum memory of decoded pixels, MB; None for no limit.

    Returns:
        Memory before, during loading and during training, MB; speed; and the time spent waiting for pixels.
    """
    cache_limit = math.inf if limit is None else limit
    config = dataclasses.replace(load_method("instant-ngp").config, data=data, vis="none", max_seconds=seconds)
    config = dataclasses.replace(config, cache_limit=cache_limit, cache_dir=folder / "cache")
    with tempfile.TemporaryDirectory() as name:
        run = Run("instant-ngp", config, "blender", load_dataparser("blender")(), Path(name) / "run")
        create_folder(run)
        content: dict[str, Any] = {"before": status("VmRSS", "RssAnon", "RssFile")}
        start = time.perf_counter()
        train_set = load_split(run, "train")
        content["loading seconds"] = round(time.perf_counter() - start, 1)
        content["pixels MB"] = round(train_set.pixels.numel() / 1e6, 1)
        content["loading"] = status("VmHWM")
        forget_peak()
        return content | train(Trainer.of(run, train_set), seconds)


def train(trainer: Trainer, seconds: float) -> dict[str, Any]:
    """Train with the `trainer` of a new run for `seconds`, and measure memory and speed."""
    state, peaks, waited = trainer.state, {"RssAnon": 0.0, "RssFile": 0.0}, [0.0]
    PixelStream.look_up = timed_into(PixelStream.look_up, waited)  # type: ignore[method-assign]
    rays = since = wait = 0.0
    while state.seconds < seconds:
        trainer.train_step()
        memory = status(*peaks)
        peaks = {name: max(peaks[name], memory.get(name, 0.0)) for name in peaks}
        if not since and state.seconds > WARM_UP * seconds:
            rays, since, wait = state.rays, state.seconds, waited[0]
    measured = state.seconds - since
    return {
        "training": {**status("VmHWM"), **peaks},
        "steps": state.step,
        "rays per second": round((state.rays - rays) / measured),
        "rays in the last step": round((trainer.model.samples_per_step or 0) / state.samples_per_ray),
        "share of time waiting for pixels": round((waited[0] - wait) / measured, 4),
        "psnr of batches": round(-10 * math.log10(state.train_mse), 2),
    }


def status(*names: str) -> dict[str, float]:
    """Return memory sizes of this process, MB, by `names` of lines of /proc/self/status; empty if it reports none."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return {}
    values = {line.split(":")[0]: line.split(":")[1] for line in lines}
    return {name: round(int(values[name].split()[0]) * 1024 / 1e6, 1) for name in names if name in values}


def forget_peak() -> None:
    """Reset VmHWM, the peak of memory, if the system allows it."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def timed_into(function: Callable[..., Any], spent: list[float]) -> Callable[..., Any]:
    """Return a function that adds the seconds of its calls of `function` to the only element of `spent`."""

    def timed(*arguments: Any) -> Any:
        start = time.perf_counter()
        result = function(*arguments)
        spent[0] += time.perf_counter() - start
        return result

    return timed


if __name__ == "__main__":
    data_, folder_, seconds_, limit_ = json.loads(sys.argv[1])
    print(json.dumps(trained_on(Path(data_), Path(folder_), seconds_, limit_)), flush=True)

"""Memory and speed of a large image set under --cache-limit, beside a small set held in memory.

    python benchmarks/cache.py [--images 250] [--width 1920] [--height 1080] [--seconds 60] [--limit 500] [--folder DIR]

enlarges renders of the embedded scene to images of that size, trains instant-ngp on them with their pixels in a file,
and on the same images at a quarter of the width with all pixels in memory, each in a process of its own. The page cache
is warm: the file has just been written. Writes benchmarks/results/cache.json (--output names another file).
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from PIL import Image

from dataparsers.blender import Blender
from dataparsers.procedural.views import write_dataset
from framework.base.console import track
from framework.base.registry import load_method
from framework.cli.session import load_split
from framework.data.pixel_stream import PixelStream
from framework.training.run import Run, create_folder
from framework.training.trainer import Trainer

RENDERED = 200
"""Width and height of the renders that are enlarged."""
WARM_UP = 0.25
"""Share of the time after which speed is measured: the grid must have found what is empty."""


def main() -> None:
    """Make the images, train twice, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--images", type=int, default=250)
    parser.add_argument("--width", type=int, default=1920)
    parser.add_argument("--height", type=int, default=1080)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--limit", type=float, default=500, help="MB")
    parser.add_argument("--folder", type=Path, help="where images and cache go; a temporary folder if not given")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "cache.json")
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--cached", type=int, default=0, help=argparse.SUPPRESS)
    flags = parser.parse_args()
    if flags.measure is not None:
        print(json.dumps(measure(flags.measure, flags.seconds, flags.limit if flags.cached else None, flags.folder)))
        return
    with tempfile.TemporaryDirectory(dir=flags.folder) as name:
        folder = Path(name)
        write_dataset(folder / "renders", size=RENDERED, counts={"train": flags.images}, progress=track)
        content: dict[str, Any] = {
            "images": flags.images,
            "size": [flags.width, flags.height],
            "seconds": flags.seconds,
        }
        for kind, share, cached in (("small, in memory", 4, 0), ("large, from a file", 1, 1), ("again", 1, 1)):
            data = folder / f"data-{share}"
            if not data.is_dir():
                enlarge(folder / "renders", data, flags.width // share, flags.height // share)
            content[kind] = in_process(data, folder, flags.seconds, flags.limit, cached)
            print(kind, json.dumps(content[kind]))
    flags.output.parent.mkdir(parents=True, exist_ok=True)
    flags.output.write_text(json.dumps(content, indent=2) + "\n")


def in_process(data: Path, folder: Path, seconds: float, limit: float, cached: int) -> dict[str, Any]:
    """`measure` in a process of its own."""
    named = {"--measure": data, "--folder": folder, "--seconds": seconds, "--limit": limit, "--cached": cached}
    command = [sys.executable, __file__, *(str(word) for pair in named.items() for word in pair)]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines()[-1])


def enlarge(source: Path, target: Path, width: int, height: int) -> None:
    """The renders over black, enlarged to the images' height and set into the middle; their cameras to match."""
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


def status(*names: str) -> dict[str, float]:
    """Lines of the process's memory, MB; nothing where the system does not tell."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return {}
    found = {line.split(":")[0]: line.split(":")[1] for line in lines}
    return {name: round(int(found[name].split()[0]) * 1024 / 1e6, 1) for name in names if name in found}


def forget_peak() -> None:
    """From here on VmHWM is the peak of what follows, where the system allows it."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def measure(data: Path, seconds: float, limit: float | None, folder: Path) -> dict[str, Any]:
    """Train for so many seconds.

    Args:
        limit: MB of pixels in memory; all of them if None.
    Returns: memory before, while loading and while training, MB; speed; and what reading cost.
    """
    config = load_method("instant-ngp").config
    limit = math.inf if limit is None else limit
    config = dataclasses.replace(
        config, data=data, vis="none", max_seconds=seconds, cache_limit=limit, cache_dir=folder / "cache"
    )
    with tempfile.TemporaryDirectory() as name:
        run = Run("instant-ngp", config.resolved(), "blender", Blender(), Path(name) / "run")
        create_folder(run)
        content: dict[str, Any] = {"before": status("VmRSS", "RssAnon", "RssFile")}
        start = time.perf_counter()
        train_set = load_split(run, "train")
        content["loading seconds"] = round(time.perf_counter() - start, 1)
        content["pixels MB"] = round(train_set.pixels.numel() / 1e6, 1)
        content["loading"] = status("VmHWM")
        forget_peak()
        content |= train(Trainer(run, train_set, None), seconds)
    return content


def train(trainer: Trainer, seconds: float) -> dict[str, Any]:
    """Memory and speed of training."""
    state, most, waited = trainer.state, {"RssAnon": 0.0, "RssFile": 0.0}, [0.0]
    PixelStream.look_up = timed_into(PixelStream.look_up, waited)  # type: ignore[method-assign]
    rays = since = wait = 0.0
    while state.seconds < seconds:
        trainer.train_step()
        now = status(*most)
        most = {name: max(most[name], now.get(name, 0.0)) for name in most}
        if not since and state.seconds > WARM_UP * seconds:
            rays, since, wait = state.rays, state.seconds, waited[0]
    measured = state.seconds - since
    return {
        "training": {**status("VmHWM"), **most},
        "steps": state.step,
        "rays per second": round((state.rays - rays) / measured),
        "rays in the last step": round(trainer.config.samples_per_batch / state.samples_per_ray),
        "share of time waiting for pixels": round((waited[0] - wait) / measured, 4),
        "psnr of batches": round(-10 * math.log10(state.train_mse), 2),
    }


def timed_into(function: Callable[..., Any], spent: list[float]) -> Callable[..., Any]:
    """The function, its seconds being added to `spent`."""

    def timed(*arguments: Any) -> Any:
        start = time.perf_counter()
        out = function(*arguments)
        spent[0] += time.perf_counter() - start
        return out

    return timed


if __name__ == "__main__":
    main()

"""Pictures of each method's result on the scene that comes with Nerfloom, for its page.

    python docs/building/method_pictures.py                    all of them, into docs/pictures/methods
    python docs/building/method_pictures.py zip-nerf kplanes   some of them
    python docs/building/method_pictures.py --seconds 120

Each picture is the first comparison that a run of the command below writes: a photograph that training never saw, the
render, the error, depth and opacity. The PSNRs of the run are written beside the pictures, into psnr.json.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from PIL import Image

ROOT = Path(__file__).parents[2]
COMMANDS = {
    "dnerf": "dnerf --canonical hash-grid {} procedural --moving True",
    "instant-ngp": "instant-ngp {}",
    "kilo-nerf": "kilo-nerf {}",
    "kplanes": "kplanes {}",
    "mip-nerf": "mip-nerf --sampler occupancy {}",
    "mip-nerf-360": "mip-nerf-360 {}",
    "nerf-plus-plus": "nerf-plus-plus --encoding hash-grid {}",
    "nerfacto": "nerfacto {}",
    "neus": "neus {}",
    "volsdf": "volsdf {}",
    "voxels": "voxels {}",
    "ref-nerf": "ref-nerf {}",
    "pixel-nerf": "pixel-nerf {} procedural --num-scenes 200 --size 32",
    "gaussian-splatting": "gaussian-splatting {}",
    "moving-gaussians": "moving-gaussians {} procedural --moving True",
    "tensorf": "tensorf {}",
    "vanilla-nerf": "vanilla-nerf --sampler occupancy {}",
    "zip-nerf": "zip-nerf {}",
}
"""Method -> flags of ns-train, as on a CPU; the budget stands at {}."""


def train(words: list[str], folder: Path) -> None:
    """Train, and judge four held-out images, in a process of its own."""
    hidden = [
        "--vis",
        "none",
        "--eval",
        "all",
        "--max-eval-images",
        "4",
        "--output-dir",
        str(folder),
        "--timestamp",
        "run",
    ]
    at = words.index("procedural") if "procedural" in words else len(words)
    command = [sys.executable, "-m", "nerfloom.cli.train", *words[:at], *hidden, *words[at:]]
    subprocess.run(command, cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)}, check=True)


def draw(name: str, seconds: float, target: Path) -> dict[str, Any]:
    """Train a method and write its picture; return its PSNRs."""
    words = shlex.split(COMMANDS[name].format(f"--max-seconds {seconds:g}"))
    with tempfile.TemporaryDirectory() as temporary:
        train(words, Path(temporary))
        (run,) = Path(temporary).glob("*/*/run")
        results = json.loads((run / "eval.json").read_text())["results"]
        summary = json.loads((run / "summary.json").read_text())
        with Image.open(min((run / "pictures").glob("*_comparison.png"))) as comparison:
            comparison.convert("RGB").save(target / f"{name}.jpg", quality=88)
    return {
        "command": shlex.join(["ns-train", *words]),
        "psnr": round(results["psnr"], 2),
        "images": results["num_images"],
        "steps": summary["steps"],
        "seconds": seconds,
    }


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help=f"which of {', '.join(COMMANDS)}; all if none is named")
    parser.add_argument("--seconds", type=float, default=60, help="seconds of training of each")
    parser.add_argument("--folder", type=Path, default=ROOT / "docs" / "pictures" / "methods")
    flags = parser.parse_args()
    flags.folder.mkdir(parents=True, exist_ok=True)
    results = flags.folder / "psnr.json"
    found = json.loads(results.read_text()) if results.is_file() else {}
    for name in flags.names or COMMANDS:
        found[name] = draw(name, flags.seconds, flags.folder)
        print(name, found[name], flush=True)
        results.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    main()

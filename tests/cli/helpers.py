"""Run the installed commands as a person would."""

import subprocess
import sys
from pathlib import Path

_FLAGS = "--num-levels 4 --max-resolution 64 --log2-table-size 12 --grid-resolution 16 --num-steps 64 --vis none"
TINY_NGP = [*_FLAGS.split(), "--samples-per-batch", "4096"]


def command(name: str) -> str:
    """The path of an installed command, beside this interpreter."""
    return str(Path(sys.executable).with_name(name))


def run(name: str, *arguments: object, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a command and capture what it prints."""
    words = [command(name), *map(str, arguments)]
    return subprocess.run(words, capture_output=True, text=True, cwd=folder, timeout=300)


def train(data: Path, output: Path, *flags: object, timestamp: str = "t") -> Path:
    """Train the tiny instant-ngp; returns the run's folder."""
    done = run(
        "ns-train", "instant-ngp", "--data", data, "--output-dir", output, "--timestamp", timestamp, *TINY_NGP, *flags
    )
    assert done.returncode == 0, done.stderr
    return output / data.name / "instant-ngp" / timestamp

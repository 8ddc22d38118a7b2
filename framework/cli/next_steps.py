"""Commands to copy at the end of a training: look at the run, film it, judge it."""

from __future__ import annotations

import shlex
from pathlib import Path

from nerfloom.data.scene import Scene
from nerfloom.evaluation.video_suffixes import default_video


def after_training(scene: Scene, folder: Path) -> list[str]:
    """Return lines that say how to look at the run in `folder`, film its `scene` along a fitting path, and judge it."""
    run = shlex.quote(str(folder))
    path = "spiral" if scene.warped else "interpolate" if scene.unbounded else "orbit"
    lines = ["next:"]
    if scene.num_scenes == 1:
        lines.append(f"  look at it in a browser:  ns-viewer {run}")
        lines.append(f"  make a video:             ns-render {path} {run} --output-path {default_video(path)}")
    if scene.num_scenes == 1 and not scene.warped:
        lines.append(f"  make a web page of it:    ns-export web {run} --output-dir exports")
    lines.append(f"  evaluate it again:        ns-eval {run}")
    return lines

"""Meshes of a trained run: their distance from the truth, and the time and memory to make them.

Each export runs as a command in its own process. The embedded scene has an exact surface. For it, the results are the
mean distances from the mesh to the surface and from the surface to the mesh, and both for parts visible to training
cameras, because nothing is known about undersides and interiors. For a capture with sparse points, the results are the
distances from these points to the mesh and to the point cloud.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from benchmarks.children import output_of
from benchmarks.exact_surfaces import surface_sample, visible_from
from nerfloom.base.child import python_command
from nerfloom.base.console import say
from nerfloom.base.errors import NerfloomError
from nerfloom.data.ply import read_points
from nerfloom.evaluation.surface_files import read_mesh
from nerfloom.evaluation.surfaces import Surface, drawn, nearest
from nerfloom.evaluation.visibility import count_sightings
from nerfloom.export.mesh import Mesh, closedness
from nerfloom.kernels import native
from nerfloom.training.machine import machine
from nerfloom.training.run import read_run

SURFACE_POINTS = 20_000
"""Number of points on the exact surface."""
MESH_POINTS, OCCLUDERS = 300_000, 1_000_000
"""Number of points on a mesh, and number of points on it that may hide others."""
EYES = 20
"""Number of training cameras used to determine visibility."""


@runtime_checkable
class KnowsItsSurface(Protocol):
    """A data format for a scene with an exact surface."""

    def signed_distance(self, points: Tensor) -> Tensor:
        """Return the distance (N,) from `points` (N, 3) of the input to the nearest surface, negative inside."""


def measure(run: Path | None, seconds: float, kinds: Sequence[str], resolutions: Sequence[int]) -> dict[str, Any]:
    """Export meshes of a run, compare them with the known truth, and print a line for each.

    Args:
        run: folder of the run; None to train instant-ngp on the embedded scene.
        seconds: training seconds for that run.
        kinds: exports of `ns-export` that produce a mesh.
        resolutions: cells along the longest edge of the box.

    Returns:
        The machine, the arguments and a row for each mesh, as plain data.
    """
    with tempfile.TemporaryDirectory() as folder:
        if run is None:
            command = python_command("nerfloom.cli.train", "instant-ngp", "--max-seconds", seconds, "--vis", "none")
            command += ["--eval", "all"]
            output_of([*command, "--output-dir", folder])
            run = next(Path(folder).rglob("config.yml")).parent
        truth = Truth(run)
        rows = []
        for kind in kinds:
            for resolution in resolutions:
                rows.append(_row(run, kind, resolution, Path(folder), truth))
                say(str(rows[-1]))
        points = truth.of_points(run, Path(folder))
        loaded = read_run(run)
        judged = run / "eval.json"
        psnr = json.loads(judged.read_text())["results"]["psnr"] if judged.is_file() else None
    result = {"machine": machine(), "kernels": native.variant(), "method": loaded.method, "format": loaded.dataparser}
    return result | {"training, s": loaded.config.max_seconds, "test PSNR, dB": psnr, "rows": rows} | points


class Truth:
    """The known surface of the scene of a `run`, its folder, in the frame of its input."""

    def __init__(self, run: Path) -> None:
        loaded = read_run(run)
        parsed = loaded.parse("train")
        self.placement = placement = parsed.placement
        poses = placement.original_poses(parsed.cameras.camera_to_worlds)
        step = max(len(poses) // EYES, 1)
        self.cameras, eyes = parsed.cameras[::step], poses[::step, :, 3]
        self.size = float((poses[:, :, 3] - poses[:, :, 3].mean(0)).norm(dim=-1).mean())
        self.distance = loaded.parser.signed_distance if isinstance(loaded.parser, KnowsItsSurface) else None
        self.sparse: Tensor | None = None
        # Points with distances too inaccurate to learn from are not used as truth either.
        points = parsed.points if parsed.sightings is None else parsed.sightings.points.unique(dim=0)
        if points is not None:
            inside = ((points >= parsed.box[0]) & (points <= parsed.box[1])).all(-1)
            self.sparse = placement.original_points(points[inside].double())
        if self.distance is not None:
            torch.manual_seed(0)
            self.points, normals = surface_sample(self.distance, parsed.box, SURFACE_POINTS)
            self.visible = visible_from(self.distance, self.points, normals, eyes)

    def of_mesh(self, mesh: Surface) -> dict[str, Any]:
        """Return the distances between `mesh` and the known surface."""
        if self.distance is not None:
            samples = drawn(mesh, MESH_POINTS)
            there, back = self.distance(samples.positions).abs(), nearest(self.points, mesh)[0]
            places = [part.placed(self.placement) for part in (samples, drawn(mesh, OCCLUDERS, seed=1))]
            seen = count_sightings(places[0], places[1], self.cameras, lambda index: None, "Looking").seen > 0
            return {
                "mesh to surface": _rounded(there),
                "surface to mesh": _rounded(back),
                "seen mesh to surface": _rounded(there[seen]),
                "seen surface to mesh": _rounded(back[self.visible]),
                "chamfer, scene units": round(float(there.mean() + back.mean()) / 2, 5),
                "chamfer of what is seen, scene units": round(
                    float(there[seen].mean() + back[self.visible].mean()) / 2, 5
                ),
            }
        if self.sparse is not None:
            return {"sparse points to mesh": _rounded(nearest(self.sparse, mesh)[0])}
        return {}

    def of_points(self, run: Path, folder: Path) -> dict[str, Any]:
        """Return the distances of sparse points from the point cloud of `run`, made in `folder`; empty without them."""
        if self.sparse is None:
            return {}
        output_of(python_command("nerfloom.cli.export", "pointcloud", run, "--output-dir", folder))
        cloud = read_points(folder / "point_cloud.ply")
        distances = nearest(self.sparse, Surface(cloud))[0]
        return {
            "sparse points in the box": len(self.sparse),
            "mean distance of the cameras from their middle, units of the input": round(self.size, 4),
            "sparse points to point cloud": _rounded(distances),
        }


def _row(run: Path, kind: str, resolution: int, folder: Path, truth: Truth) -> dict[str, Any]:
    """Make one mesh, and return its row."""
    output = folder / f"{kind}-{resolution}"
    command = python_command("nerfloom.cli.export", kind, run, "--resolution", resolution, "--output-dir", output)
    start = time.monotonic()
    with (folder / "log.txt").open("w+b") as log:
        child = subprocess.Popen(command, stdout=log, stderr=log)
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        if child.returncode:
            log.seek(0)
            last = log.read().decode(errors="replace").strip().splitlines()[-1:]
            raise NerfloomError(f"ns-export {kind} failed: {' '.join(last)}")
    elapsed = time.monotonic() - start
    mesh = read_mesh(output / "mesh.ply")
    assert mesh.faces is not None
    return {
        "export": kind,
        "resolution": resolution,
        "seconds": round(elapsed, 1),
        "CPU seconds": round(usage.ru_utime + usage.ru_stime, 1),
        "peak memory, MB": round(usage.ru_maxrss / 1000),
        "faces": len(mesh.faces),
        "watertight": closedness(Mesh(mesh.points, mesh.faces)).watertight,
        "file, MB": round((output / "mesh.ply").stat().st_size / 1e6, 1),
        **truth.of_mesh(mesh),
    }


def _rounded(distances: Tensor) -> dict[str, float]:
    """Return mean and median of distances (N,)."""
    return {"mean": round(float(distances.mean()), 5), "median": round(float(distances.median()), 5)}

"""The command `ns-export`: points, meshes, Gaussians, pages and more, in the frame and units of the input."""

from __future__ import annotations

from typing import Any

from nerfloom.base.from_nerfstudio import EXPORTING
from nerfloom.cli.common import chosen_kind, entry_point, make_room, refuse_foreign, with_format, with_run
from nerfloom.cli.export_flags import (
    CameraFlags,
    LevelsFlags,
    MarchingCubesFlags,
    OccupancyFlags,
    PointFlags,
    SplatFlags,
    TsdfFlags,
    WebFlags,
)
from nerfloom.cli.flags import read_flags
from nerfloom.cli.run_flags import OPENS

USAGE = """\
usage: ns-export WHAT RUN_FOLDER --output-dir DIR [flags]

  tsdf            mesh.ply, .obj or .glb: a mesh of what the training cameras see; for captures, and every method
  marching-cubes  mesh.ply, .obj or .glb: a mesh of where a field is dense; for objects, closed; not of Gaussians
  pointcloud      point_cloud.ply: points on surfaces, with colours and normals
  gaussian-splat  splat.ply, .spz, .sog or .glb: the Gaussians of a run, for other programs
  levels          scene.levels: the Gaussians of a large scene in levels of detail; a picture loads what it needs
  web             scene.html: one file that shows the scene in any browser with WebGL 2, from disk, offline
  cameras         nerfstudio/transforms.json and colmap/sparse/0: the cameras of all photographs, refined if the run
                  refined them; transforms_train.json: the training cameras, in nerfstudio's format
  occupancy       occupancy.npz and occupancy.ply: the cells that the method samples, if it has a grid

  ns-export tsdf RUN_FOLDER --output-dir exports

Instead of a run, pass a file of Gaussians (.ply, .spz, .sog, .splat, .ksplat): gaussian-splat, levels and web need no
data, others --data DIR. web also shows an octree of ns-bake (.octree), and levels (.levels), which stream.

  ns-export web splat.ply --output-dir exports

ns-export WHAT --help shows its flags. All files use the frame and units of the input, or the unit that ns-measure
has set. In .glb files, y is up.
"""


@entry_point
def main(arguments: list[str]) -> None:
    """Run ns-export on the `arguments` of the process."""
    name, (kind, file), rest = chosen_kind(arguments, KINDS, USAGE, "nothing is exported as")
    refuse_foreign(rest, EXPORTING, "ns-export")
    words, named = with_format(f"ns-export {name}", with_run(rest))
    flags = read_flags(kind, f"ns-export {name}", words, takes=OPENS)
    found = flags.check()
    path = flags.output_dir / file.format_map(vars(flags))
    make_room(path)
    flags.write(name, found, named, path)


KINDS: dict[str, tuple[type[Any], str]] = {
    "pointcloud": (PointFlags, "point_cloud.ply"),
    "marching-cubes": (MarchingCubesFlags, "mesh.{format}"),
    "tsdf": (TsdfFlags, "mesh.{format}"),
    "gaussian-splat": (SplatFlags, "splat.{format}"),
    "levels": (LevelsFlags, "scene.levels"),
    "cameras": (CameraFlags, "transforms_train.json"),
    "occupancy": (OccupancyFlags, "occupancy.npz"),
    "web": (WebFlags, "scene.html"),
}
"""Kind of export -> its flags, and the file that it writes."""

if __name__ == "__main__":
    main()

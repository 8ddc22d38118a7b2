"""The part of `ns-eval` that compares the run's surface with a reference."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerfloom.base.console import console, say
from nerfloom.cli.geometry_flags import GeometryFlags
from nerfloom.evaluation.geometry import Geometry, Views, judge_surface, region_of
from nerfloom.evaluation.surface_files import read_mesh, read_points
from nerfloom.evaluation.surfaces import Surface, point_spacing, usable
from nerfloom.export.surface import SurfaceKind, kind_for, surface_mesh

if TYPE_CHECKING:
    from rich.table import Table
    from torch import Tensor

    from nerfloom.training.loaded import Loaded


def read_reference(flags: GeometryFlags) -> Surface | None:
    """Return the reference that `flags` name; None if they name none.

    Raises:
        DataError: if its file cannot be used.
    """
    if flags.reference_mesh is not None:
        return read_mesh(flags.reference_mesh)
    return None if flags.reference_points is None else read_points(flags.reference_points)


def evaluate_geometry(
    flags: GeometryFlags, mesh: Path | None, loaded: Loaded, reference: Surface
) -> tuple[dict[str, Any], str | None]:
    """Judge a run's surface, or a given mesh, and print a table.

    Args:
        flags: the flags of the comparison.
        mesh: file of the mesh to judge; None to make one of the run.
        loaded: the run.
        reference: the surface to compare with.

    Returns:
        The content of eval.json, and a warning or None.

    Raises:
        ConfigError: if there is no surface, or nothing of it counts.
        DataError: if the file of the mesh cannot be used.
    """
    start = time.monotonic()
    kind = kind_for(loaded.model) if flags.surface == "auto" else flags.surface
    surface = _made(flags, loaded, reference, kind) if mesh is None else replace(read_mesh(mesh), normals=None)
    source = kind if mesh is None else str(mesh)
    views = None if flags.min_views == 0 else _views(loaded, flags.min_views)
    found = judge_surface(surface, reference, views, flags.f_score_at, flags.crop)
    console.print(_distances(found))
    console.print(_f_scores(found))
    for line in _notes(flags, found, surface, reference, source, loaded.scale.unit or "the input's unit"):
        say(line)
    content = {
        "reference": str(flags.reference),
        "surface": source,
        "faces": len(surface.corners),
        "vertices": len(surface.points),
        "min_views": flags.min_views,
        "crop": flags.crop,
        "seconds": time.monotonic() - start,
        **found.as_plain(),
    }
    return content, found.warning


def _made(flags: GeometryFlags, loaded: Loaded, reference: Surface, kind: SurfaceKind) -> Surface:
    """Return the surface that an export finds."""
    low = high = None
    if flags.crop is not None:
        low, high = (tuple(corner.tolist()) for corner in region_of(reference, flags.crop))
    mesh = surface_mesh(loaded, kind, flags.surface_resolution, low, high, whole=flags.min_views == 0)
    return usable(Surface(mesh.vertices, mesh.faces), f"the mesh by {kind}")[0]


def _views(loaded: Loaded, least: int) -> Views:
    """Return the training cameras, and the pixels of their images that count."""
    dataset = loaded.dataset("train")

    def kept(index: int) -> Tensor | None:
        mask = dataset.kept_of(index)
        return None if mask is None else mask.cpu()

    def opaque(index: int) -> Tensor | None:
        mask = kept(index)
        if not dataset.scene.has_alpha:
            return mask
        shown = dataset.image(index)[..., 3].cpu() > 0
        return shown if mask is None else shown & mask

    return Views(dataset.cameras.to("cpu"), loaded.placement, kept, opaque, least)


def _distances(found: Geometry) -> Table:
    """Return distances as a table, in the input's unit and in percent of the reference's longest side."""
    from rich.table import Table

    table = Table("", "mean", "% of side", "median")
    for name, mean, median in (
        ("accuracy", found.accuracy.mean, f"{found.accuracy.median:.4g}"),
        ("completeness", found.completeness.mean, f"{found.completeness.median:.4g}"),
        ("Chamfer distance", found.chamfer, ""),
    ):
        table.add_row(name, f"{mean:.4g}", f"{100 * mean / found.side:.3f}", median)
    return table


def _f_scores(found: Geometry) -> Table:
    """Return F-scores as a table, by their distances."""
    from rich.table import Table

    table = Table("distance", "% of side", "F-score", "precision", "recall")
    for score in found.f_scores:
        shares = (f"{share:.1%}" for share in (score.f_score, score.precision, score.recall))
        table.add_row(f"{score.distance:.4g}", f"{100 * score.distance / found.side:.3g}", *shares)
    return table


def _notes(
    flags: GeometryFlags, found: Geometry, surface: Surface, reference: Surface, source: str, unit: str
) -> list[str]:
    """Return lines about the compared surfaces, the unit of lengths, and the omissions."""
    seen = "every point counts" if flags.min_views == 0 else f"what {flags.min_views} or more training cameras see"
    left_out, reference_left_out = found.left_out.describe(), found.reference_left_out.describe()
    lines = [
        f"surface: {source}, {surface.describe()}; reference: {flags.reference}, {reference.describe()}",
        f"lengths are in {unit}; the reference's longest side is {found.side:.6g}",
        "accuracy: distance of the surface from the reference; completeness: of the reference from the surface; "
        "Chamfer: the mean of both",
        f"judged: {seen}; surface: {left_out}; reference: {reference_left_out}",
    ]
    if reference.faces is None:
        apart = point_spacing(reference.points)
        lines.append(f"the reference's points are about {apart:.3g} apart; they cannot resolve smaller distances")
    if found.normals is None:
        return ["normals: the reference has none", *lines]
    return [f"normals: {found.normals.degrees:.2f} degrees on average, |cos| {found.normals.cosine:.4f}", *lines]

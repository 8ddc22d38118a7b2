"""Metrics of a reconstructed surface against a reference: distances both ways, F-scores, and normals.

With S the points of the reconstruction and R the points of the reference, each drawn evenly by area:

- accuracy is the mean distance from S to the reference, completeness the mean distance from R to the reconstruction;
- the Chamfer distance is the mean of the two;
- at a distance d, precision is the share of S nearer than d to the reference, recall the share of R nearer than d to
  the reconstruction, and the F-score is 2 P R / (P + R) (Knapitsch et al. 2017, Tanks and Temples);
- the normals' consistency is the mean |cos| of the angle between the normals of a point and of its nearest point
  (Mescheder et al. 2019, Occupancy Networks), and their error the mean of that angle, both averaged over S and R.

Only points that cameras see count. Each surface decides by itself which of its points they see, so that a
reconstruction far from the reference is judged and not left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.poses import Placement
from nerfloom.evaluation.surfaces import Samples, Surface, drawn, nearest
from nerfloom.evaluation.visibility import Shown, count_sightings

NUM_POINTS = 100_000
"""Number of points on each surface."""
DENSE, OCCLUDERS = 8, 10
"""For each judged point: number of points that find nearest faces, and number of points that may hide others."""
F_SCORE_AT = (0.0025, 0.01)
"""Default distances of F-scores, in sides of the reference's bounding box."""
ELSEWHERE = 0.2
"""Warn if a median distance is at least this many sides: the surfaces probably differ in frame or unit."""


@dataclass(frozen=True)
class Distances:
    """Distances from points to the other surface, in the input's unit."""

    mean: float
    """Their mean."""
    median: float
    """Their median."""

    @classmethod
    def of(cls, distances: Tensor) -> Distances:
        """Return the statistics of `distances` (N,)."""
        return cls(float(distances.mean()), float(distances.median()))


@dataclass(frozen=True)
class FScore:
    """Shares of points that are near to the other surface."""

    distance: float
    """Maximum distance that counts as near, in the input's unit."""
    precision: float
    """Share of the reconstruction's points, 0 to 1."""
    recall: float
    """Share of the reference's points, 0 to 1."""

    @property
    def f_score(self) -> float:
        """The harmonic mean of precision and recall, 0 to 1."""
        total = self.precision + self.recall
        return 2 * self.precision * self.recall / total if total else 0.0


@dataclass(frozen=True)
class NormalError:
    """Angles between the normals of points and of their nearest points, whichever way the normals point."""

    degrees: float
    """Mean angle, 0 to 90 degrees."""
    cosine: float
    """Mean |cos| of the angle, 0 to 1."""


@dataclass(frozen=True)
class LeftOut:
    """Shares of a surface's points that do not count, by the first reason that applies."""

    beyond: float
    """Outside of the region that is compared."""
    outside: float
    """In the images of too few cameras."""
    masked: float
    """In enough images, but at pixels that do not count."""
    hidden: float
    """Behind the surface itself."""

    @property
    def total(self) -> float:
        """Share of all points that do not count."""
        return self.beyond + self.outside + self.masked + self.hidden

    def describe(self) -> str:
        """Return the shares as text, in percent."""
        reasons = {
            "outside of --crop": self.beyond,
            "in too few images": self.outside,
            "masked": self.masked,
            "hidden": self.hidden,
        }
        named = ", ".join(f"{share:.1%} {reason}" for reason, share in reasons.items() if share)
        return f"{self.total:.1%} left out" + (f" ({named})" if named else "")


@dataclass(frozen=True)
class Views:
    """The cameras that decide which points count."""

    cameras: Cameras
    """The training cameras, on the CPU."""
    placement: Placement
    """Placement of the surfaces' frame in the cameras'."""
    kept: Shown
    """The pixels of their images that count for the reconstruction: masks keep them."""
    opaque: Shown
    """The pixels that count for the reference: they are `kept` and not transparent."""
    least: int = 1
    """Number of cameras that have to see a point."""


@dataclass(frozen=True)
class Geometry:
    """A surface judged against a reference. Lengths are in the input's unit."""

    side: float
    """Longest side of the reference's bounding box."""
    accuracy: Distances
    """Distances from the reconstruction to the reference."""
    completeness: Distances
    """Distances from the reference to the reconstruction."""
    f_scores: tuple[FScore, ...]
    """F-scores at several distances, in ascending order."""
    normals: NormalError | None
    """None if the reference has no normals."""
    left_out: LeftOut
    """Points of the reconstruction that do not count."""
    reference_left_out: LeftOut
    """Points of the reference that do not count."""

    @property
    def chamfer(self) -> float:
        """The mean of accuracy and completeness."""
        return (self.accuracy.mean + self.completeness.mean) / 2

    @property
    def warning(self) -> str | None:
        """A warning if the two surfaces are far from each other; None otherwise."""
        if max(self.accuracy.median, self.completeness.median) < ELSEWHERE * self.side:
            return None
        return (
            f"half of the surface or of the reference is farther than {ELSEWHERE:.0%} of its side from the other: are "
            "they in the same frame and unit?"
        )

    def as_plain(self) -> dict[str, Any]:
        """Return the metrics as a dictionary for JSON."""
        content = asdict(self) | {"chamfer": self.chamfer, "chamfer_percent": 100 * self.chamfer / self.side}
        for plain, score in zip(content["f_scores"], self.f_scores, strict=True):
            plain["f_score"] = score.f_score
        return content


def judge_surface(
    surface: Surface,
    reference: Surface,
    views: Views | None = None,
    f_score_at: Sequence[float] = (),
    crop: float | None = None,
    count: int | None = None,
) -> Geometry:
    """Compare a reconstructed mesh with a reference, in the reference's frame and unit.

    Args:
        surface: the reconstructed mesh.
        reference: a mesh, or points with or without normals.
        views: cameras that decide which points count; if None, all do.
        f_score_at: distances of F-scores; if empty, `F_SCORE_AT` of the reference's side.
        crop: if given, only points in the reference's bounding box count; the box is enlarged on all sides by this many
            of its longest sides.
        count: number of points on each surface; None for `NUM_POINTS`.

    Raises:
        ConfigError: if no point of a surface counts.
    """
    count = NUM_POINTS if count is None else count
    side, dense = reference.side, DENSE * count
    region = None if crop is None else region_of(reference, crop)
    kept, opaque = (None, None) if views is None else (views.kept, views.opaque)
    ours, our_share = _counted(surface, "the surface", count, region, views, kept)
    theirs, their_share = _counted(reference, "the reference", count, None, views, opaque)
    there, normals_there = nearest(ours.positions, reference, dense)
    back, normals_back = nearest(theirs.positions, surface, dense)
    near = sorted(f_score_at) or [share * side for share in F_SCORE_AT]
    errors = [_cosines(ours.normals, normals_there), _cosines(theirs.normals, normals_back)]
    return Geometry(
        side,
        Distances.of(there),
        Distances.of(back),
        tuple(FScore(d, float((there < d).double().mean()), float((back < d).double().mean())) for d in near),
        _normal_error([cosines for cosines in errors if cosines is not None]),
        our_share,
        their_share,
    )


def region_of(reference: Surface, crop: float) -> tuple[Tensor, Tensor]:
    """Return the corners (3,) of the bounding box of `reference`, enlarged on all sides by `crop` of its longest."""
    used = reference.points if reference.faces is None else reference.points[reference.faces.reshape(-1)]
    return used.amin(0) - crop * reference.side, used.amax(0) + crop * reference.side


def _counted(
    surface: Surface,
    name: str,
    count: int,
    region: tuple[Tensor, Tensor] | None,
    views: Views | None,
    pixels: Shown | None,
) -> tuple[Samples, LeftOut]:
    """Return the points of a surface that count, and the shares of the others."""
    points = drawn(surface, count)
    total, beyond = len(points.positions), 0
    if region is not None:
        within = ((points.positions >= region[0]) & (points.positions <= region[1])).all(-1)
        points, beyond = points[within], total - int(within.sum())
    seen = torch.ones(len(points.positions), dtype=torch.bool)
    unseen = [0, 0, 0]
    if views is not None and pixels is not None and len(seen):
        places = [part.placed(views.placement) for part in (points, drawn(surface, OCCLUDERS * count, seed=1))]
        found = count_sightings(places[0], places[1], views.cameras, pixels, f"Looking at {name}")
        inside, shown, seen = (number >= views.least for number in (found.inside, found.shown, found.seen))
        unseen = [int(part.sum()) for part in (~inside, inside & ~shown, shown & ~seen)]
    left_out = LeftOut(*(number / total for number in (beyond, *unseen)))
    if not bool(seen.any()):
        raise ConfigError(
            f"no point of {name} counts: {left_out.describe()}; is it in the frame and unit of the input? "
            "--min-views 0 judges everything"
        )
    return points[seen], left_out


def _cosines(one: Tensor | None, other: Tensor | None) -> Tensor | None:
    """Return |cos| (N,) between two sets of unit normals; None if one is unknown."""
    return None if one is None or other is None else (one * other).sum(-1).abs().clamp(max=1)


def _normal_error(cosines: list[Tensor]) -> NormalError | None:
    """Return the errors of normals, averaged over the given directions; None if there is none."""
    if not cosines:
        return None
    angles = [float(each.acos().mean()) for each in cosines]
    degrees = torch.rad2deg(torch.tensor(sum(angles) / len(angles), dtype=torch.float64))
    return NormalError(float(degrees), sum(float(each.mean()) for each in cosines) / len(cosines))

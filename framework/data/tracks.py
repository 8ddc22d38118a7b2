"""Tracks of a reconstruction: the images that see each sparse point, and the accuracy of its distances."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

MIN_IMAGES = 2
"""Minimum number of training images that see a point; one image alone determines no distance."""
MAX_DEVIATION = 0.1
"""Maximum standard deviation of a distance in use, as a fraction of the distance."""
MIN_TRACK_LENGTH = 3
"""Minimum number of images that observe a point in use; two can agree on a wrong one."""
MAX_ERROR = 2.0
"""Maximum mean reprojection error of a point in use, pixels."""
DOUBTS = (
    "",
    "without a track",
    f"seen by fewer than {MIN_TRACK_LENGTH} images",
    f"with a reprojection error above {MAX_ERROR:g} pixels",
)
"""Reasons not to use a point's distances, as indexed by `doubts_about`; the first entry means that there is none."""


@dataclass(frozen=True)
class Sightings:
    """O sightings of sparse points in M images; a point that three images see appears three times."""

    images: Tensor
    """(O,) int64 image of each sighting."""
    points: Tensor
    """(O, 3) position of the point, scene units."""
    deviations: Tensor
    """(O,) standard deviation of its distance from the image's camera, scene units."""

    def __len__(self) -> int:
        return len(self.images)

    def of_images(self, chosen: Tensor) -> Sightings:
        """Return the sightings in the images `chosen` (S,) int64, each once, which are renumbered."""
        kept, images = _renumbered(self.images, chosen)
        return Sightings(images, self.points[kept], self.deviations[kept])


@dataclass(frozen=True)
class Observations:
    """O observations: pairs of an image and a sparse point that it sees, with or without known distances."""

    images: Tensor
    """(O,) int64 image of each observation."""
    points: Tensor
    """(O,) int64 point of each observation."""

    def of_images(self, chosen: Tensor) -> Observations:
        """Return the observations in the images `chosen` (S,) int64, which are renumbered."""
        kept, images = _renumbered(self.images, chosen)
        return Observations(images, self.points[kept])

    def of_points(self, chosen: Tensor) -> Observations:
        """Return the observations of the points `chosen` (K,) bool, which are renumbered."""
        kept = chosen[self.points]
        return Observations(self.images[kept], (chosen.cumsum(0) - 1)[self.points[kept]])

    def observed(self, count: int) -> Tensor:
        """Return whether an image sees each of `count` points, (count,) bool."""
        return torch.bincount(self.points, minlength=count) > 0


@dataclass(frozen=True)
class Tracks:
    """K sparse points, and O sightings of them in M images."""

    points: Tensor
    """(K, 3) positions."""
    images: Tensor
    """(O,) int64 image of each sighting."""
    seen: Tensor
    """(O,) int64 point of each sighting."""
    angles: Tensor
    """(O,) standard deviation of each sighting's direction, radians: the reprojection error over the focal length."""
    doubts: Tensor
    """(K,) int64 index in `DOUBTS` of the reason not to use a point's distances; 0 to use them."""

    def of_images(self, chosen: Tensor) -> Tracks:
        """Return all points, and the sightings in images `chosen` (S,) int64, each once, renumbered."""
        kept, images = _renumbered(self.images, chosen)
        return replace(self, images=images, seen=self.seen[kept], angles=self.angles[kept])

    def without(self, images: Tensor) -> Tracks:
        """Return all points, without the sightings in `images` (M,) bool."""
        kept = ~images[self.images]
        return replace(self, images=self.images[kept], seen=self.seen[kept], angles=self.angles[kept])

    def at(self, points: Tensor) -> Tracks:
        """Return the same sightings with moved points.

        Args:
            points: (K, 3) new positions. Points that are not finite are left out, and the others renumbered.
        """
        finite = points.isfinite().all(-1)
        kept = finite[self.seen]
        seen = (finite.cumsum(0) - 1)[self.seen[kept]]
        return Tracks(points[finite], self.images[kept], seen, self.angles[kept], self.doubts[finite])

    def confirmed(self) -> Tensor:
        """Return whether at least `MIN_IMAGES` of the images see a point, (K,) bool."""
        return self._counts() >= MIN_IMAGES

    def known_without(self, images: Tensor) -> Tensor:
        """Return whether the position of each point is known without some images, (K,) bool.

        This holds if these images do not see the point, or if at least `MIN_IMAGES` others do.

        Args:
            images: (M,) bool, the images.
        """
        others = self.without(images)
        return others.confirmed() | (others._counts() == self._counts())

    def _counts(self) -> Tensor:
        """Return the number of sightings of each point, (K,)."""
        return torch.bincount(self.seen, minlength=len(self.points))

    def known_distances(self, centers: Tensor) -> Tensor:
        """Return whether the distance of each sighting is accurate enough to learn from, (O,) bool.

        This holds if at least `MIN_IMAGES` images see the point, it has no doubts, and its distance deviates little.

        Args:
            centers: (M, 3) positions of the cameras.
        """
        return self._known(distance_deviations(self, centers), centers)

    def sightings(self, centers: Tensor) -> Sightings:
        """Return the sightings from camera positions `centers` (M, 3) with accurate distances (`known_distances`)."""
        deviations = distance_deviations(self, centers)
        known = self._known(deviations, centers)
        return Sightings(self.images[known], self.points[self.seen[known]].float(), deviations[known].float())

    def _known(self, deviations: Tensor, centers: Tensor) -> Tensor:
        distances = (self.points[self.seen] - centers[self.images].to(self.points)).norm(dim=-1)
        believed = self.confirmed() & (self.doubts == 0)
        return believed[self.seen] & (deviations <= MAX_DEVIATION * distances)


def doubts_about(lengths: Tensor, errors: Tensor) -> Tensor:
    """Return the reason in `DOUBTS` against each point's distances, (K,) int64, or 0.

    `lengths` (K,) are numbers of images that observe a point, `errors` (K,) mean reprojection errors in pixels.
    """
    doubts = torch.where(errors > MAX_ERROR, 3, 0)
    doubts[lengths < MIN_TRACK_LENGTH] = 2
    doubts[lengths == 0] = 1
    return doubts


def distance_deviations(tracks: Tracks, centers: Tensor) -> Tensor:
    """Return the standard deviation (O,) float64 of the distance from each sighting's camera to its point.

    A sighting in the unit direction d at distance r, with an angular error of a, constrains the point across its ray
    and not along it: its information is (1 - d d^T) / (r a)^2. The inverse of the sum over the track is the covariance
    of the point (Hartley and Zisserman 2004, section 5.2). Its part along a ray is the variance of the distance. So the
    result depends on the reprojection error, the number of images, and the angle between their rays. A weak prior that
    the point is near its estimated distance keeps the covariance of a single sighting finite.

    Args:
        tracks: K points and O sightings.
        centers: (M, 3) positions of the cameras.
    """
    apart = tracks.points[tracks.seen].double() - centers.double()[tracks.images]
    squared = apart.square().sum(-1).clamp(min=1e-24)
    outer = apart[:, :, None] * apart[:, None, :] / squared[:, None, None]
    eye = torch.eye(3, dtype=torch.float64, device=apart.device)
    spread = squared * tracks.angles.double().square().clamp(min=1e-24)
    across = (eye - outer) / spread[:, None, None] + outer / squared[:, None, None]
    information = across.new_zeros(len(tracks.points), 3, 3).index_add_(0, tracks.seen, across)
    unseen = torch.bincount(tracks.seen, minlength=len(tracks.points)) == 0
    covariance, singular = torch.linalg.inv_ex(torch.where(unseen[:, None, None], eye, information))
    deviations = ((covariance[tracks.seen] * outer).sum((-1, -2))).clamp(min=0).sqrt()
    return deviations.masked_fill(singular[tracks.seen] > 0, torch.inf)  # points so far away that nothing holds them


def _renumbered(images: Tensor, chosen: Tensor) -> tuple[Tensor, Tensor]:
    """Return which sightings are in `chosen` images, and the indices of their images among these."""
    most = int(max(images.max() if len(images) else -1, chosen.max() if len(chosen) else -1)) + 1
    places = torch.full((most,), -1, dtype=torch.int64, device=images.device)
    places[chosen] = torch.arange(len(chosen), device=images.device)
    found = places[images]
    return found >= 0, found[found >= 0]

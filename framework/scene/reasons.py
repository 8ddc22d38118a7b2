"""Reasons, in messages, of decisions that several methods make."""

from __future__ import annotations

DEPTH_REASONS = {True: "there are depth images", False: "there are no depth images"}
"""Reason for or against a depth loss, by whether there are depth images."""
SPARSE_DEPTH_REASON = "the reconstruction's points are seen in {:,} pixels"
"""Reason for a depth loss, with the number of pixels in which images see sparse points."""
LIGHT_REASONS = {True: "light differs between the images", False: "the images are lit alike"}
"""Reason for or against an appearance vector per image, by whether light, exposure or camera differ."""
POSE_REASONS = {
    "exact": "the poses are exact",
    "photographs": "the poses were estimated from the photographs",
    "device": "the poses were tracked by the device",
}
"""Reason for or against refining poses, by their source (`Scene.poses`)."""
MARCHED_REASON = "marched samples carry no gradient to rays"
"""Reason for not refining inexact poses."""

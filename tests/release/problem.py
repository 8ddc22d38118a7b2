"""Obstacles to a release."""


class Problem(Exception):
    """Something that must be put right before a release; the message describes it."""

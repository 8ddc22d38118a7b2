"""Exports of a trained run for other programs, in the frame and units of its input."""

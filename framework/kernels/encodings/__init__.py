"""Encodings without parameters, and the contraction of space."""

"""Encodings that hold parameters."""

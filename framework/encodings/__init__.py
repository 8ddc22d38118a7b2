"""Encodings with learnt parameters."""

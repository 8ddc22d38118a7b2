"""Whole images: similarity, and tests against silhouettes."""

"""Whole images: similarity, and what silhouettes show."""

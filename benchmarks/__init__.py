"""Measurements behind the documents: `python -m benchmarks WHAT`, from the repository's root."""

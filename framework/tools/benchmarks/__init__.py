"""Benchmarks of `ns-bench`: repeatable measurements of speed and error."""

"""Benchmarks that need nothing but the framework: what its parts are worth where the truth is known."""

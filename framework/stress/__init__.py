"""Stress tests of methods: hard scenes and conditions, runs under them, and verdicts."""

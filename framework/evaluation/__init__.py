"""Evaluation: one evaluator for every method."""

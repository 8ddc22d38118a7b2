"""Evaluation of any method by one evaluator, and images and camera paths for people."""

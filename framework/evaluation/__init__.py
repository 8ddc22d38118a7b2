"""Evaluation of all methods by one evaluator, and images and camera paths for people."""

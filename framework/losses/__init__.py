"""Objectives: the terms that a method lists, and the functions of tensors that they are made of."""

"""Bugs by what they spoil, one module a part of the framework."""

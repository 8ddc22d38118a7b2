"""Throw-away methods of kinds that no built-in method is."""

"""Nerfloom's methods in other people's programs: one file a program, which none of the framework knows of."""

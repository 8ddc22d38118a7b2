"""Octrees whose leaves have density and colour: their values in bytes, pictures of them, and their files."""

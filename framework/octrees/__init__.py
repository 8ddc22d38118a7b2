"""Octrees with density and colour in their leaves: their values in bytes, pictures of them, and their files."""

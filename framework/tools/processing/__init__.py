"""Photographs, videos and phone captures become data folders: a transforms.json with images beside it."""

"""Conversion of images, videos and phone captures to data folders: a transforms.json with images beside it."""

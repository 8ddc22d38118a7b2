"""Data sets: reading of images, masks and depths, caches of decoded pixels, and batches."""

"""From files to pixels: images, masks, depths, caches, and batches drawn from them."""

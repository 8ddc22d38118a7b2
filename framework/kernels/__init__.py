"""The hot loops, one file an operation: the readable torch reference, the fast path, and what chooses between them."""

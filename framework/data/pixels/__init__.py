"""Pixels of a data set: where they are kept, and the batches drawn from them."""

"""Adapters to other programs, one module or a few for each; the framework does not depend on them."""

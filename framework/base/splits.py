"""Parts of a data set."""

from typing import Literal

Split = Literal["train", "val", "test"]
"""Images to train on, to evaluate during training, and to evaluate after it."""

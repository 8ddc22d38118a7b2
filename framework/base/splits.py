"""Parts of a data set."""

from typing import Literal

Split = Literal["train", "val", "test"]
"""Images to learn from, to look at while training, and to judge by."""

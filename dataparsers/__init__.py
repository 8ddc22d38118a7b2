"""Data formats, one file or package each."""

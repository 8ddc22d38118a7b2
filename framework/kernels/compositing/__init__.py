"""Compositing of samples along rays."""

"""Plugins that bring one part each, for an existing method."""

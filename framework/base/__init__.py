"""Configs, error messages, devices and the registry of names, on which all other rooms build."""

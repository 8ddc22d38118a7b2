"""Configs, errors, devices and other basics that all other rooms use."""

"""Measurements that anybody can repeat: `ns-bench`."""

"""Comparison of several methods on one data set, under the same conditions: runs, measurements, report."""

"""Several methods on one data set, under the same conditions: runs, figures, report."""

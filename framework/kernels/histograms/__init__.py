"""Histograms along rays: intervals, step functions, sampling by them, and spacing."""

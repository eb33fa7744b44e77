"""Experiments: declared in one file, run on all cores, reported on one page."""

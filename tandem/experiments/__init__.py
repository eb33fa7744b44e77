"""The paper's experiment and your own: declared in one file, run on all cores, reported on one page."""

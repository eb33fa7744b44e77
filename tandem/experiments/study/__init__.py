"""An experiment: its declaration, its runs and their results."""

"""Measurements of the solver and of live loops; each compares within one run."""

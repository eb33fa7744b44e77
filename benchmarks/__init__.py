"""Measurements of the solver beside others, on the same recorded states, in one run."""

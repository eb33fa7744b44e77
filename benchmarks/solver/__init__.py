"""The solver beside others, on the same recorded states, in one run."""

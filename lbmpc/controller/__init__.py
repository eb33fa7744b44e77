"""One control step, and what stands in for a solution where there is none."""

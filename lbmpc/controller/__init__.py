"""One control step, and the fallback inputs for a tick without a solution."""

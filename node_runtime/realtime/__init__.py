"""One clock, slots on its grid, and what makes a Python loop punctual."""

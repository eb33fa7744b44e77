"""The clock, slots on its grid, and measures that make a Python loop punctual."""

"""Rigorous enclosures of a plant's motion: interval arithmetic, Taylor series, bounds of the disturbance."""

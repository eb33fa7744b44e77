"""Invariant sets: terminal, tube, minimal, robust control invariant, and regions around them."""

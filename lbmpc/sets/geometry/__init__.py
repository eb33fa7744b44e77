"""Polytopes and the operations on them."""

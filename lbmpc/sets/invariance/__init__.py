"""Invariant sets of the plant, and of the plant under linear feedback."""

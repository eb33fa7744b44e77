"""Polytopes, disturbance tubes and invariant sets."""

"""Closed-loop runs in lock-step, with faults."""

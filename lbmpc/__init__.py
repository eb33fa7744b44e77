"""Learning-based model predictive control: pure functions and small classes, no clock and no I/O."""

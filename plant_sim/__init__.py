"""The simulated plant, and what acts on it while its controller is silent."""

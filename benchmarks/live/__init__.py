"""Live runs: their punctuality and their use of the machine."""

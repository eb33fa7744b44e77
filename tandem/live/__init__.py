"""`tandem run`: its processes, their supervision and their display."""

"""`tandem run`: its processes, watched and shown."""

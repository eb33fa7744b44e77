"""Code that all processes share: configuration, bus, inbox, pacing, real-time priority, health."""

"""What every process shares: configuration, bus, inbox, pacing, real-time priority, health."""

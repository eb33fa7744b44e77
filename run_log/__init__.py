"""The log of a run: written as MCAP while it happens; read, replayed, summarised and drawn afterwards."""

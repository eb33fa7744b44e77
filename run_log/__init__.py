"""The log of a run: written as MCAP during the run; read, replayed, summarised and drawn afterwards."""

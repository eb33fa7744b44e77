"""Computing every command of a log again."""

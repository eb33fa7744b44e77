"""Compute every command of a log again."""

"""A log as tables for other tools: CSV, Parquet and Rerun."""

"""The configuration: typed, strict, read from TOML."""

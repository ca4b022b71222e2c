"""Studies: questions as data, read from TOML, changed by flags and converted to expectations."""

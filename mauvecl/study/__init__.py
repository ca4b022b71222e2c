"""A question as data: read from TOML, changed by flags, turned into expectations."""

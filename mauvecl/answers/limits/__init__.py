"""Limits: the value of a quantity at which a flare is detected, and its dependence on assumptions."""

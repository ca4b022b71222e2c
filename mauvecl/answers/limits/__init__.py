"""How faint, how small, how short: the value of a quantity at which a flare is detected, and what moves it."""

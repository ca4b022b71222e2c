"""The page of `mauvecl serve` (the extra ``web``): controls, closed forms at once, simulation on demand."""

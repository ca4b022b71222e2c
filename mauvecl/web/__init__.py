"""Page of `mauvecl serve` (extra ``web``): controls, immediate closed forms, simulation on demand."""

"""Would flares be seen: detect, map, gaussian, and what it costs not to know the instrument."""

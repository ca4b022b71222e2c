"""From stars, neighbours and sky to mean electrons per pixel."""

#: Default surface brightness, V mag arcsec-2: the ecliptic opposite the Sun in the paper's table.
DEFAULT_SKY = 22.1

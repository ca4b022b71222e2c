"""Exposures: mean electrons per pixel from the light of stars, neighbours and sky."""

#: Default surface brightness, V mag arcsec-2: the ecliptic opposite the Sun in the paper's table.
DEFAULT_SKY = 22.1

"""The sky: zodiacal light, by place and date."""

#: V mag arcsec-2 where nothing is said of the sky: the ecliptic opposite the Sun, in the paper's table.
DEFAULT_SKY = 22.1

"""What would be measured of flares."""

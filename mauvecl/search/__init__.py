"""Search of light curves for flares, false alarms and completeness."""

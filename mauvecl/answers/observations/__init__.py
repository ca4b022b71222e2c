"""What observed frames hold: flares, their false alarms, and what is excluded."""

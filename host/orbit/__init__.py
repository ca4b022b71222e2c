"""The orbit: where the satellite is, what it can see and when, and what it meets on the way; nothing is downloaded."""

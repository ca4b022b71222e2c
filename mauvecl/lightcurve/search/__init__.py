"""Searches for flares in stares: template banks, false alarms, completeness from injections, and yields."""

"""The command line: `app` puts the verbs together; the rest is what they share, from flags to failures."""

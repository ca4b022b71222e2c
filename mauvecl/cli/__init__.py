"""The command line: `app` puts the verbs together; the others hold some verbs each, their flags, and their running."""

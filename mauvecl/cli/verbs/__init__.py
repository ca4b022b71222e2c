"""The verbs, a few to a file: each asks for an answer, and shows it."""

"""Pictures of answers and reports, drawn by matplotlib."""

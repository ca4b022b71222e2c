"""One flare: its shape in time, its energy, and how often there are such."""

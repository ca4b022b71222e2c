"""Answers over a season: when targets are seen, and what a campaign on them would bring."""

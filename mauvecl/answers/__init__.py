"""Answers to studies, one module per verb, and their files."""

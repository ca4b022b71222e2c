"""Answers about campaigns: visibility of targets, and expected flares."""

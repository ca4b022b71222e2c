"""Detections: thresholds, probabilities, ROC curves, rare tails, departures from closed forms, campaigns."""

"""Detections: thresholds, probabilities, ROC, rare tails, departures from the closed forms, campaigns of many tests."""

"""Statistics, their distributions, detections and S/N."""

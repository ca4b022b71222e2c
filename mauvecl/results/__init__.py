"""What is made of what a device counted: detections, S/N, ROC, rare tails, departures from the closed forms."""

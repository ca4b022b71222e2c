"""Results of simulations: detections, S/N, ROC curves, rare tails, departures from closed forms, measurements."""

"""Looking for flares in stares: a bank of filters, its false alarms, what it finds of injected flares, and yields."""

"""Pictures with matplotlib (the extra ``plot``): of answers, of plans, of what goes in. Nothing is computed here."""

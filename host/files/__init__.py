"""Files from outside and of our own: read within limits, written whole or not at all."""

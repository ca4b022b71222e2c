"""Read files of users within limits, and write files whole or not at all."""

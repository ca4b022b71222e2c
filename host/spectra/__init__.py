"""Read spectra of users and archives, check them, and continue their ends."""

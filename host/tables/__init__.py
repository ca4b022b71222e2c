"""Tables of users in any form: one place for units, names, times, coordinates, checksums and missing values."""

"""The command line: `app` assembles the verbs; the other modules hold what verbs share, from flags to errors."""

import gc

# Modules and tables consist of a million objects, and hardly any of them is part of a cycle. Looking for cycles less
# often saves a tenth of a command's time, and has to begin before the modules are imported.
gc.set_threshold(10_000)

"""The command line: `app` assembles the commands; the other modules are shared by all, from flags to errors."""

import gc

# Modules and tables consist of a million objects, hardly any of them in a cycle. Less frequent garbage collection saves
# a tenth of a command's time, and must be set before the modules are imported.
gc.set_threshold(10_000)

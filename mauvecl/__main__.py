"""`python -m mauvecl`."""

from mauvecl.cli import main

main()

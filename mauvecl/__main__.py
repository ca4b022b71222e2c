"""`python -m mauvecl`."""

from mauvecl.cli.app import main

main()

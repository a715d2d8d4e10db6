"""`python -m modetune.flows` is the command line."""

from modetune.flows.cli import main

main()

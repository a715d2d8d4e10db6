"""`python -m modetune` is the command line."""

from modetune.flows.cli.main import main

main()

"""The command line as ``python -m polsep``."""

from polsep.cli import main

main()

"""`python -m wasp_cli` is `wasp`."""

from wasp_cli.cli.app import main

if __name__ == "__main__":
    main()

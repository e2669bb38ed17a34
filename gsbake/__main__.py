"""`python -m gsbake` is the `gsbake` command."""

from gsbake.cli import main

if __name__ == "__main__":
    main()

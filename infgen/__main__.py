"""``python -m infgen``: the command line, also where another package is called ``cli``."""

from cli import main

if __name__ == "__main__":
    main()

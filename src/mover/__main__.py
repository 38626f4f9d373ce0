"""`python -m mover` is the command line, wherever the package is found."""

from mover.app.cli import main

if __name__ == "__main__":
    main()

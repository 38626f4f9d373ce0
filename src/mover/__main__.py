"""`python -m mover` is the command line, wherever the package is found."""

from .cli import main

if __name__ == "__main__":
    main()

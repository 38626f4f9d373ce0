"""What is said of bad input. Imports nothing, so that commands answer at once."""


class InputError(Exception):
    """Bad user data: the message names the file, the field, what was found, what was expected."""

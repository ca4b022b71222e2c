"""Exception for bad input."""


class InputError(ValueError):
    """Bad input from a user.

    The message is one sentence that names the thing, its value and what was expected; the command
    line prints it as it is and exits with code 2.
    """

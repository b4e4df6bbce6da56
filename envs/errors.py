"""The one exception for what a user can get wrong."""


class InputError(ValueError):
    """Bad input: one line that names the file, row, field or option, what was expected, and what to do.

    The commands print it and exit with status 2.
    """

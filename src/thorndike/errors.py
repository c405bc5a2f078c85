"""The one exception for a user's mistake: its message is one line that says what was expected, what came, and how to mend it."""


class UserError(ValueError):
    """A mistake in what the user asked for. The command line prints the message and exits with status 2."""

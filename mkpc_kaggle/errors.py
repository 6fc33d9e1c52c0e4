"""What goes wrong on the user's side, told so that the user can mend it."""


class UserError(Exception):
    """The run cannot start: the message says what happened, where, and what to do next."""

"""The one exception that means: the user can mend this, and one line says how."""


class UserError(Exception):
    """A mistake that the user can mend; its message is one line, shown without a traceback."""

"""Errors that a program can act on. Each message states what failed, where, and the remedy."""


class EcodError(Exception):
    """Base of all errors of this package."""


class Unreachable(EcodError, ConnectionError):
    """Nobody answers as a broker at the address."""


class Refused(EcodError, PermissionError):
    """The broker refuses the login, a subscription or a report."""


class Silent(EcodError, TimeoutError):
    """Nothing arrived within the given timeout."""


class Invalid(EcodError, ValueError):
    """A value that the protocol does not allow."""

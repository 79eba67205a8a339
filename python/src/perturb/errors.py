"""The errors of this package. Each message says what was received, what was expected and what to do."""

from __future__ import annotations


class PerturbError(Exception):
    """The base of all errors of this package."""


class InvalidArgumentError(PerturbError, ValueError):
    """An argument is wrong, for example a NaN action, an array of a wrong shape, or a parameter out of bounds."""


class AssignmentError(PerturbError, AttributeError):
    """An attribute cannot be assigned, because the assignment would have no effect.

    The message names the call that changes the physics.
    """


class UnknownNameError(PerturbError, KeyError):
    """There is no environment, parameter, test or condition of this name."""

    __str__ = Exception.__str__  # KeyError's own __str__ puts quotation marks around the message


class PolicyError(PerturbError, ValueError):
    """A policy cannot be loaded, does not fit the environment, or returns values that are not actions."""


class NotAllowedError(PerturbError, PermissionError):
    """The role of this client's token does not permit the requested parameters."""


class ServerFullError(PerturbError, RuntimeError):
    """The server has reached its limit of environments, sessions or memory."""


class ServerUnavailableError(PerturbError, RuntimeError):
    """The server cannot serve the request now, for example because it cannot write its ledger.

    Nothing has changed. The request may succeed later.
    """


class RenderError(PerturbError, RuntimeError):
    """The server cannot draw the environment. The environment itself is not affected.

    Either the server has no graphics library or is too old to draw, or the physics diverged, or the drawing failed.
    """


class OutOfOrderError(PerturbError, RuntimeError):
    """A method was called out of order, for example `step` before the first `reset` or after the end of an episode."""


class ServerDefectError(PerturbError, RuntimeError):
    """The server failed because of a bug. The environments of the session are lost."""


class ProtocolError(PerturbError, RuntimeError):
    """A reply does not follow the protocol, or the server serves another revision of the environment."""


class ServerConnectionError(PerturbError, ConnectionError):
    """No server answers at the address, or the connection broke. The environments of the session are lost."""


class ServerTimeoutError(PerturbError, TimeoutError):
    """The server did not reply within the timeout. The environments of the session are lost."""


class ServerStartError(PerturbError, RuntimeError):
    """A program of perturb was not found, or a private or embedded server did not start."""


# The error class for each gRPC status code in the protocol's message Error.
_BY_CODE: dict[int, type[PerturbError]] = {
    3: InvalidArgumentError,
    5: UnknownNameError,
    7: NotAllowedError,
    8: ServerFullError,
    9: OutOfOrderError,
    13: ServerDefectError,
    14: ServerUnavailableError,
}


def refusal(kind: str, code: int, message: str) -> PerturbError:
    """Return the exception for a request that the server refused with the protocol's message Error.

    `kind` is the kind of request, such as `step` or `render`.
    """
    if kind == "render" and code in (9, 13):  # a failed drawing does not affect the environments
        return RenderError(message)
    if kind == "render" and code == 3:  # sizes were checked before, so the server does not know this kind of request
        return RenderError(f"the server cannot draw, it may be older than this package: {message}")
    error = _BY_CODE.get(code)
    return ProtocolError(f"error with the unknown code {code}: {message}") if error is None else error(message)

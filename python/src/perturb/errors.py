"""Everything that this package raises. Each message says what came, what was expected and what to do."""

from __future__ import annotations


class PerturbError(Exception):
    """The base of all errors of this package."""


class InvalidArgumentError(PerturbError, ValueError):
    """A value is wrong: a NaN action, an array of a wrong shape, a parameter outside its bounds."""


class AssignmentError(PerturbError, AttributeError):
    """An attribute cannot be assigned, because that would change nothing. The message says which call would."""


class UnknownNameError(PerturbError, KeyError):
    """The server knows no environment, or no parameter, of this name."""

    __str__ = Exception.__str__  # a KeyError would put quotation marks around the sentence


class PolicyError(PerturbError, ValueError):
    """A policy cannot be loaded, does not fit the environment, or returns values that are not actions."""


class NotAllowedError(PerturbError, PermissionError):
    """The token's role does not allow the parameters that would be drawn."""


class ServerFullError(PerturbError, RuntimeError):
    """The server has no room for so many environments or sessions."""


class ServerUnavailableError(PerturbError, RuntimeError):
    """The server cannot do it now, but may later; for example, it cannot write its ledger. Nothing has changed."""


class RenderError(PerturbError, RuntimeError):
    """The server cannot draw the environment, which is unharmed.

    It has no graphics library, or is older than pictures; the physics diverged; or the drawing failed.
    """


class OutOfOrderError(PerturbError, RuntimeError):
    """A call out of order: a step before the first reset, or after an episode's end without a reset."""


class ServerDefectError(PerturbError, RuntimeError):
    """The server failed by a defect of its own."""


class ProtocolError(PerturbError, RuntimeError):
    """A reply does not follow the protocol, or the server serves another revision of the environment."""


class ServerConnectionError(PerturbError, ConnectionError):
    """No server answers, or the connection to it broke. The environments of the session are gone."""


class ServerTimeoutError(PerturbError, TimeoutError):
    """The server did not answer in time. The environments of the session are gone."""


class ServerStartError(PerturbError, RuntimeError):
    """The program perturb-server was not found, or the private server did not start."""


# gRPC's status codes, as the protocol's message Error has them.
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
    """Turn the protocol's Error, a refusal of a request by the server, into an exception with the server's sentence."""
    if kind == "render" and code in (9, 13):  # a drawing that failed leaves the environments alone
        return RenderError(message)
    if kind == "render" and code == 3:  # sizes are checked before they are sent: it does not know the request
        return RenderError(f"the server cannot draw, it may be older than this package: {message}")
    error = _BY_CODE.get(code)
    return ProtocolError(f"error with the unknown code {code}: {message}") if error is None else error(message)

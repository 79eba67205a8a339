"""Addresses of servers."""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass
from pathlib import Path

from .catalogue import MAX_SOCKET_PATH_BYTES
from .errors import InvalidArgumentError


@dataclass(frozen=True)
class Address:
    """Address of a server: `unix:/path`, `host:port`, with TLS `https://host:port`, or `embedded`."""

    target: str

    def __str__(self) -> str:
        return self.target


# The address of the embedded server, which runs in this process.
EMBEDDED = Address("embedded")


def parse_address(text: str) -> Address:
    """Parse the address of a server.

    Valid addresses are `unix:/path`, `host:port`, `http://host:port` and `tcp://host:port` without TLS,
    `https://host:port` with TLS, and `embedded`.

    Raises:
        InvalidArgumentError: if the address is malformed. The message says what is wrong.
    """

    def refuse(reason: str) -> InvalidArgumentError:
        forms = "write unix:/path, [http:// or tcp://]host:port, with TLS https://host:port, or embedded"
        return InvalidArgumentError(f"server={text!r} is not a server's address: {reason}; {forms}")

    if not isinstance(text, str):
        raise refuse("it is not a string")
    if text == EMBEDDED.target:
        return EMBEDDED
    if text.startswith("unix:"):
        path = text.removeprefix("unix:")
        if path.startswith("//"):
            path = path.removeprefix("//")
            if not path.startswith("/"):
                raise refuse("the path after unix:// must be absolute")
        if not path:
            raise refuse("the path of the socket is missing")
        path = str(Path(path).absolute())  # a relative path is relative to the working directory
        if len(path.encode()) > MAX_SOCKET_PATH_BYTES:
            raise refuse(f"the path of the socket is longer than the {MAX_SOCKET_PATH_BYTES} bytes that Linux allows")
        return Address(f"unix:{path}")
    scheme = next((scheme for scheme in ("https://", "http://", "tcp://") if text.startswith(scheme)), "")
    rest = text.removeprefix(scheme)
    rest = rest.removesuffix("/")
    host, separator, port = rest.rpartition(":")
    if not separator:
        raise refuse("the port is missing")
    if not re.fullmatch(r"[0-9]{1,5}", port) or not 1 <= int(port) <= 65535:
        raise refuse(f"{port!r} is not a port (1 to 65535)")
    if host.startswith("[") and host.endswith("]"):
        if not _is_ipv6(host[1:-1]):
            raise refuse(f"{host[1:-1]!r} is not an IPv6 address")
    elif not re.fullmatch(r"[A-Za-z0-9._-]+", host):
        raise refuse(f"{host!r} is not a host name; an IPv6 address must stand in brackets")
    return Address(f"{scheme if scheme == 'https://' else ''}{host}:{port}")


def _is_ipv6(host: str) -> bool:
    try:
        return ipaddress.IPv6Address(host).scope_id is None  # URLs cannot contain a scope such as %eth0
    except ValueError:
        return False

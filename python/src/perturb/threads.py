"""Threads that this package starts."""

from __future__ import annotations

import resource
import threading
from collections.abc import Callable
from typing import Any

from .errors import PerturbError


def start_thread(name: str, function: Callable[..., None], *arguments: Any) -> threading.Thread:
    """Start a daemon thread that calls a function.

    Raises:
        PerturbError: if the system cannot start another thread. The message names the limit.
    """
    thread = threading.Thread(target=function, name=name, args=arguments, daemon=True)
    try:
        thread.start()
    except RuntimeError as error:
        limit = resource.getrlimit(resource.RLIMIT_NPROC)[0]
        raise PerturbError(
            f"the system cannot start another thread or process ({error}): this user may have "
            f"{'unlimited' if limit == resource.RLIM_INFINITY else limit} of them in all (`ulimit -u`, RLIMIT_NPROC), "
            "and a container as many as its pids.max; raise the limit, or end other programs"
        ) from error
    return thread

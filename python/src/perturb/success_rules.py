"""Success rules that Python applies to recorded episodes: thresholds of the return or length, and functions."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from .errors import InvalidArgumentError
from .policy import native

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from . import _native

# A success rule as a text, or as a function. The function gets the columns of recorded episodes, and returns bool
# [episodes].
SuccessRule: TypeAlias = str | Callable[[Mapping[str, Any]], Any]

_THRESHOLD = re.compile(r"\s*(return|length)\s*(>=|<=|=)\s*(\S+)\s*")


@dataclass(frozen=True)
class OwnRule:
    """A success rule that Python applies to recorded episodes."""

    # The name of the quantity that is compared, such as `return`, or the name of a function.
    quantity: str
    # Whether success needs a quantity of at least the threshold. If false, it needs one of at most the threshold.
    at_least: bool
    threshold: float
    # Returns the quantity of each episode, [episodes], from the records' columns.
    values: Callable[[Mapping[str, Any]], Any]

    def judge(self, records: _native.Records) -> _native.Records:
        """Return records of the same episodes, judged by this rule.

        Raises:
            InvalidArgumentError: if the function returns a wrong shape or type.
        """
        columns = records.columns()
        episodes = len(columns["seed"])
        values: NDArray[Any] = np.asarray(self.values(columns))
        if values.shape != (episodes,) or values.dtype.kind not in "biuf":
            raise InvalidArgumentError(
                f"the rule of success {self.quantity} gave {values.dtype} of the shape {values.shape}; expected bool "
                f"of the shape ({episodes},), one for each episode of the columns"
            )
        judged: _native.Records = native(
            records.judged, self.quantity, self.at_least, self.threshold, np.ascontiguousarray(values, np.float64)
        )
        return judged


def parse(rule: SuccessRule | None) -> tuple[str | None, OwnRule | None]:
    """Parse a success rule. Return the rule for the native module, and the rule for Python.

    The native module applies its rule while episodes are recorded. Python applies its rule to the finished records. At
    least one of the two is None. `return=NUMBER` means at least this return.

    Raises:
        InvalidArgumentError: if the rule is neither a text nor a function, or if a threshold is malformed.
    """
    if rule is None:
        return None, None
    if callable(rule):
        name = getattr(rule, "__name__", type(rule).__name__)
        return None, OwnRule("rule()" if name == "<lambda>" else f"{name}()", True, 1.0, rule)
    if not isinstance(rule, str):
        raise InvalidArgumentError(
            f"success is {rule!r}; expected 'text', 'code', a threshold such as 'steps=90', 'return>=300' or "
            "'length<=90', or a function of the records' columns"
        )
    matched = _THRESHOLD.fullmatch(rule)
    if matched is None:
        return rule, None
    quantity, sign, number = matched.groups()
    try:
        threshold = float(number)
    except ValueError:
        threshold = float("nan")
    if not np.isfinite(threshold) or (sign == "=" and quantity != "return"):
        raise InvalidArgumentError(
            f"success is {rule!r}; expected a number after a sign, such as 'return>=300' or 'length<=90'"
        )
    return None, OwnRule(quantity, sign != "<=", threshold, lambda columns: columns[quantity])


def is_own(rule: str | None) -> bool:
    """Whether Python applies the success rule `QUANTITY=NUMBER`, as opposed to the native module."""
    quantity = "" if rule is None else rule.partition("=")[0]
    return quantity in ("return", "length") or quantity.endswith("()")

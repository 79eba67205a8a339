"""Dictionaries of infos that cost what they are used for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


class Later(dict[str, Any]):
    """A dictionary that is filled when somebody looks: most that steps bring are never looked at.

    Pickled and copied it is a plain one.
    """

    __slots__ = ("_fill",)

    def __init__(self, fill: Callable[[], dict[str, Any]]) -> None:
        # An empty one some readers in C, as that of json, would not look into.
        super().__init__(unfilled=True)
        self._fill: Callable[[], dict[str, Any]] | None = fill

    def __reduce_ex__(self, protocol: Any) -> tuple[Any, ...]:
        return dict, (dict(self),)


def _filling(name: str) -> Callable[..., Any]:
    method = getattr(dict, name)

    def look(self: Later, *args: Any, **kwargs: Any) -> Any:
        fill = self._fill
        if fill is not None:
            # Another thread may be here, too, or read already: who comes second changes nothing but equal values.
            dict.update(self, fill())
            dict.pop(self, "unfilled", None)
            self._fill = None
        return method(self, *args, **kwargs)

    look.__name__ = name
    return look


# Whatever reads or changes a dictionary. To override __iter__ is what has dict() and ** ask, too.
for _name in (
    *("__contains__", "__delitem__", "__eq__", "__getitem__", "__ior__", "__iter__", "__len__", "__ne__", "__or__"),
    *("__repr__", "__reversed__", "__ror__", "__setitem__", "clear", "copy", "get", "items", "keys", "pop", "popitem"),
    *("setdefault", "update", "values"),
):
    setattr(Later, _name, _filling(_name))

"""Refusal of attribute assignments that would have no effect, such as `env.length = 1.0`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .errors import AssignmentError

if TYPE_CHECKING:
    from .catalogue import Description


def refuse_assignment(name: str, description: Description) -> AssignmentError:
    """Return the error for an assignment such as `env.length = 1.0`. Its message says how to change a parameter."""
    parameters = list(description.parameters)
    if name in parameters:
        example, what = name, f"it is a parameter of {description.name}'s physics, which the server holds"
    else:
        example = (parameters or ["length"])[0]
        what = (
            "this environment has no such attribute, so nothing would change; parameters of "
            f"{description.name}'s physics are {', '.join(parameters)}"
        )
    return AssignmentError(
        f"{name!r} cannot be assigned: {what}; call set_parameters({{{example!r}: …}}), which acts at the next "
        f"episode, or reset(options={{'parameters': {{{example!r}: …}}}}), or give parameters= where the "
        "environment is made"
    )


class CheckedAttributes:
    """Base class that refuses new public attributes once the object is constructed.

    Subclasses that are defined outside this package may add attributes.
    """

    _description: Description
    _is_made = False

    def __setattr__(self, name: str, value: Any) -> None:
        """Assign an existing attribute.

        Raises:
            AssignmentError: if the name is that of a parameter, or a public name that does not exist.
        """
        if self._is_made and not name.startswith("_"):
            is_own = name in self.__dict__ or hasattr(type(self), name)
            if name in self._description.parameters or not (is_own or self._allows_new_attributes()):
                raise refuse_assignment(name, self._description)
        super().__setattr__(name, value)

    def _allows_new_attributes(self) -> bool:
        """Whether the object's class is defined outside this package."""
        return not type(self).__module__.startswith(f"{__package__}.")

"""The names of version 0.1 still work, and cause a warning."""

from __future__ import annotations

import pytest

import perturb


@pytest.mark.parametrize(("old", "new"), [("assess", "evaluate"), ("Part", "Bin"), ("Cell", "Bin2D")])
def test_old_names_are_found_with_a_warning(old: str, new: str) -> None:
    with pytest.warns(DeprecationWarning, match=rf"perturb\.{old} is now perturb\.{new}"):
        found = getattr(perturb, old)
    assert found is getattr(perturb, new)
    assert old not in perturb.__all__


def test_other_names_are_not_found() -> None:
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = perturb.nonsense  # type: ignore[attr-defined]

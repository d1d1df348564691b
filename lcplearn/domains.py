"""Which numbers an argument may be: checked in one place, and read where numbers are learned."""

import math
from collections.abc import Mapping
from numbers import Real
from typing import Any, NamedTuple, Protocol


class Domain(NamedTuple):
    """Numbers from low to high; finite, and without the ends where these are open.

    A number without bounds is learned in multiples of `unit`, so that one learning rate fits all numbers of a scene.
    """

    low: float
    high: float
    open_low: bool
    words: str
    unit: float = 1.0

    def __contains__(self, value: object) -> bool:
        if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
            return False
        number = float(value)
        return self.low <= number <= self.high and not (self.open_low and number == self.low)


REAL = Domain(-math.inf, math.inf, False, "a finite number")
POSITIVE = Domain(0.0, math.inf, True, "a positive number")
NOT_NEGATIVE = Domain(0.0, math.inf, False, "a number of at least 0")
SHARE = Domain(0.0, 1.0, False, "a number from 0 to 1")


def check(domain: Domain, **values: Any) -> None:
    """Check numbers by name; what is no plain number (a tensor, say) is left to whoever made it.

    Looking into a tensor would wait for its device.

    Raises:
        ValueError: A number is outside the domain.
    """
    for name, value in values.items():
        if isinstance(value, Real) and value not in domain:
            raise ValueError(f"{name}: expected {domain.words}, got {value}")


class Numbered(Protocol):
    """A scene that says which of its arguments are numbers, and of which domain."""

    @property
    def numbers(self) -> Mapping[str, Domain]: ...

    @property
    def dt(self) -> float: ...


def check_numbers(scene: Numbered) -> None:
    """Check dt and all `numbers` of a scene, in tuples too.

    Raises:
        ValueError: One is outside its domain; the message names it.
    """
    check(POSITIVE, dt=scene.dt)
    for name, domain in scene.numbers.items():
        value = getattr(scene, name)
        for each in value if isinstance(value, tuple) else (value,):
            check(domain, **{name: each})


def positive(name: str, value: float) -> float:
    """A positive, finite number, as float.

    Raises:
        ValueError: It is not one; the message names it.
    """
    if value not in POSITIVE:
        raise ValueError(f"{name}: expected a positive number, got {value!r}")
    return float(value)

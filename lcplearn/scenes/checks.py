"""What the constructors of scenes check."""

from torch import Tensor


def require_positive(**values: float | Tensor) -> None:
    """Check numbers; tensors are left to whoever makes them, because looking into one waits for its device.

    Raises:
        ValueError: A number is not positive.
    """
    for name, value in values.items():
        if not isinstance(value, Tensor) and not value > 0:
            raise ValueError(f"{name}: expected a positive number, got {value}")

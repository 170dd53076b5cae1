"""Check the keywords of the environments; each error names the keyword, its value and the expected values."""

from collections.abc import Collection
from typing import Any

import numpy as np


def finite(name: str, value: float, is_valid: bool = True, requirement: str = "") -> float:
    """Check that a number is finite and valid; return it as a float."""
    if not (np.isfinite(value) and is_valid):
        raise ValueError(f"{name}={value} must be finite{requirement}")
    return float(value)


def positive(name: str, value: float) -> float:
    """Check that a number is finite and positive; return it as a float."""
    return finite(name, value, value > 0, " and positive")


def not_negative(name: str, value: float, hint: str = "") -> float:
    """Check that a number is finite and at least 0; return it as a float."""
    return finite(name, value, value >= 0, f" and not negative{hint}")


def between(name: str, value: float, low: float, high: float, unit: str) -> float:
    """Check that a number is between two limits; return it as a float."""
    if not low <= value <= high:
        raise ValueError(f"{name}={value} must be between {low:g} and {high:g}{unit}")
    return float(value)


def count(name: str, value: Any, hint: str = "") -> int:
    """Check that a value is an integer of at least 1; return it."""
    if not (isinstance(value, (int, np.integer)) and value >= 1):
        raise ValueError(f"{name}={value!r} must be an integer of at least 1{hint}")
    return int(value)


def one_of(name: str, value: str, choices: Collection[str]) -> str:
    """Check that a name is one of the choices; return it."""
    if value not in choices:
        raise ValueError(f"{name}={value!r} must be one of {list(choices)}")
    return value


def low_high(name: str, value: Any, form: str = "(low, high)", shape: tuple[int, ...] = (2,), unit: str = "") -> Any:
    """Check the lower and upper limits of a number or of a vector's components; return the limits as an array."""
    array = np.asarray(value, dtype=np.float64)
    if array.shape != shape or not np.isfinite(array).all() or (array[0] > array[1]).any():
        raise ValueError(f"{name}={value} must be {form} of finite numbers{unit}, low <= high")
    return array

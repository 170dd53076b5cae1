"""Checks of the environments' keywords: each error names the keyword, its value and what was expected."""

from collections.abc import Collection
from typing import Any

import numpy as np


def finite(name: str, value: float, is_valid: bool = True, requirement: str = "") -> float:
    """Return a finite number, which fulfils a further requirement, as a float."""
    if not (np.isfinite(value) and is_valid):
        raise ValueError(f"{name}={value} must be finite{requirement}")
    return float(value)


def positive(name: str, value: float) -> float:
    """Return a finite positive number as a float."""
    return finite(name, value, value > 0, " and positive")


def not_negative(name: str, value: float, hint: str = "") -> float:
    """Return a finite number of at least 0 as a float."""
    return finite(name, value, value >= 0, f" and not negative{hint}")


def between(name: str, value: float, low: float, high: float, unit: str, *, strict: bool = False) -> float:
    """Return a number between two limits as a float; ``strict``: and not equal to one."""
    if not low <= value <= high or (strict and value in (low, high)):
        raise ValueError(f"{name}={value} must be between {low:g} and {high:g}{unit}")
    return float(value)


def count(name: str, value: Any, hint: str = "") -> int:
    """Return an integer of at least 1."""
    if not (isinstance(value, (int, np.integer)) and value >= 1):
        raise ValueError(f"{name}={value!r} must be an integer of at least 1{hint}")
    return int(value)


def one_of(name: str, value: str, choices: Collection[str]) -> str:
    """Return a name that is one of several."""
    if value not in choices:
        raise ValueError(f"{name}={value!r} must be one of {list(choices)}")
    return value


def low_high(name: str, value: Any, form: str = "(low, high)", shape: tuple[int, ...] = (2,), unit: str = "") -> Any:
    """Return the lowest and the highest value, of a number or of each component of a vector, as an array."""
    array = np.asarray(value, dtype=np.float64)
    if array.shape != shape or not np.isfinite(array).all() or (array[0] > array[1]).any():
        raise ValueError(f"{name}={value} must be {form} of finite numbers{unit}, low <= high")
    return array

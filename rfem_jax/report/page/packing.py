"""Arrays as the page holds them: 16-bit integers with a scale, or 32-bit floats, in base64.

Place in the pipeline: used by all modules that make content of the page; `assets/data.js` reads them.
"""

import base64
from typing import Any

import numpy as np
from jaxtyping import Float

Packed = dict[str, Any]
MISSING = -32768  # of an integer: NaN


def pack_integers(values: Float[np.ndarray, "..."]) -> Packed:
    """Values to 1/32767 of the largest one: for what is drawn."""
    values = np.asarray(values, dtype=float)
    finite = np.isfinite(values)
    scale = float(np.max(np.abs(values), initial=0.0, where=finite)) / 32767.0 or 1.0
    numbers = np.where(finite, np.round(np.where(finite, values, 0.0) / scale), MISSING)
    return {"type": "i2", "scale": scale, "shape": list(values.shape), "data": _encode(numbers, "<i2")}


def pack_floats(values: Float[np.ndarray, "..."]) -> Packed:
    """Values to seven digits: for what is read off."""
    values = np.asarray(values)
    return {"type": "f4", "shape": list(values.shape), "data": _encode(values, "<f4")}


def _encode(values: np.ndarray, kind: str) -> str:
    with np.errstate(over="ignore"):
        return base64.b64encode(np.ascontiguousarray(values.astype(kind)).tobytes()).decode("ascii")


def stride_for(rows: int, most: int) -> int:
    """The smallest step through rows that leaves no more than `most`."""
    return max(1, -(-rows // max(most, 1)))


def some_rows(rows: int, most: int) -> np.ndarray:
    """Every k-th of some rows, no more than `most` and the last one."""
    chosen = np.arange(0, rows, stride_for(rows, most))
    return chosen if rows == 0 or chosen[-1] == rows - 1 else np.append(chosen, rows - 1)

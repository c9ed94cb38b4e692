"""What a sensor shows of a signal that it filters: low passes, a high pass, the mean over a sampling interval.

Place in the pipeline: predictions -> **sensor_filters** -> residuals, observability.

    x' = A x + B u,  y = C x + D u,   u linear between saved times, x(0) = -A^-1 B u(0)             (17.16), (17.17)

With the time T of the filter, whose cut-off frequency is 1/(2 pi T):

    low_pass      T y' + y = u
    butterworth   T^2 y'' + sqrt(2) T y' + y = u
    high_pass     T y' + y = T u'
    average       y(t) = 1/T integral of u from t - T to t

All are linear, so that derivatives of a signal are filtered as the signal is.

Symbols: T saved times.
"""

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.linalg import expm

from rfem_jax.description.tasks.identification import Sensor
from rfem_jax.tolerancing.identification.predictions import spline

Curves = Float[np.ndarray, "T ..."]


def sensed(times: Float[np.ndarray, " T"], values: Curves, sensor: Sensor) -> CubicSpline:
    """The curves that a sensor makes of those with these values at the saved times."""
    return spline(times, filtered(times, values, sensor))


def filtered(times: Float[np.ndarray, " T"], values: Curves, sensor: Sensor) -> Curves:
    """Values (T, ...) at the saved times behind the sensor's filter; before the first one signals did not change."""
    if not sensor.filter:
        return values
    if sensor.filter == "average":
        return _average(times, values, sensor.filter_time)
    a, b, c, d = _state_space(sensor.filter, sensor.filter_time)
    flat = values.reshape(len(times), -1)
    state = np.linalg.solve(-a, b)[:, None] * flat[0]
    found, known = np.empty_like(flat), {}
    found[0] = c @ state + d * flat[0]
    for k, step in enumerate(np.diff(times)):
        rounded = float(f"{step:.9e}")
        if rounded not in known:
            known[rounded] = _over_a_step(a, b, rounded)
        kept, first, second = known[rounded]
        state = kept @ state + first[:, None] * flat[k] + second[:, None] * flat[k + 1]
        found[k + 1] = c @ state + d * flat[k + 1]
    return found.reshape(values.shape)


def _state_space(kind: str, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """A, B, C, D."""
    rate = 1.0 / time
    if kind == "butterworth":
        return np.array([[0.0, rate], [-rate, -np.sqrt(2.0) * rate]]), np.array([0.0, rate]), np.array([1.0, 0.0]), 0.0
    first = np.array([[-rate]]), np.array([rate])
    return (*first, np.array([1.0]), 0.0) if kind == "low_pass" else (*first, np.array([-1.0]), 1.0)


def _over_a_step(a: np.ndarray, b: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the state after a step has of the state before it, and of the signal at both ends: the exponential of the
    equations of state, signal and its slope."""
    n = len(b)
    whole = np.zeros((n + 2, n + 2))
    whole[:n, :n], whole[:n, n], whole[n, n + 1] = a * step, b * step, 1.0
    grown = expm(whole)
    return grown[:n, :n], grown[:n, n] - grown[:n, n + 1], grown[:n, n + 1]


def _average(times: np.ndarray, values: Curves, interval: float) -> Curves:
    """Means over the last interval, of the spline through the values."""
    integral = spline(times, values).antiderivative()
    early = (times[0] - (times - interval)).reshape(-1, *[1] * (values.ndim - 1))
    before = np.maximum(early, 0.0) * values[0]
    return (integral(times) - integral(np.maximum(times - interval, times[0])) + before) / interval

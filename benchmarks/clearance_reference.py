"""A rigid slider-crank with play at its wrist pin, by an own code that shares nothing with rfem_jax or Exudyn.

    Crank, Contact -> first_impacts   one run, DOP853 from contact to contact
                      batch           many runs at once by Runge-Kutta 4, steps that follow contact

The crank turns at a constant rate, so that the angle theta of the rod and the place s of the slider are the only
coordinates.  In the plane, with x along the guide and the second axis down (rotations about +y are then positive from
the first to the second), u = (cos theta, sin theta) along the rod and u' across it, B the crank pin:

    (I + m c^2) theta'' = L2 u' . f + m c u' . (g - B''),    m_s s'' = -f_x,    f = -N e / |e|,

e from the middle of the bush, which the slider holds, to the pin, N by Hunt and Crossley's law with a given chi or with
Lankarani and Nikravesh's.  Sources: as `rfem_jax.mechanics.laws.contact_law` names them; Newton and Euler's equations.

Symbols: y = (theta, s, theta', s') [rad, m, rad/s, m/s]; SI.
"""

from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import minimize_scalar

GRAVITY = 9.81  # m/s^2, across the guide


class Crank(NamedTuple):
    """The mechanism: rate [rad/s] of the crank; lengths of crank and rod [m]; rod: mass [kg], moment of inertia about
    its mass centre [kg m^2], place of this from the crank pin [m]; mass of the slider [kg]."""

    rate: float
    crank: float = 0.05
    rod: float = 0.12
    mass: float = 0.21
    inertia: float = 2.5e-4
    centre: float = 0.06
    slider: float = 0.14

    def start(self) -> np.ndarray:
        """y at the angle zero, pin and bush concentric, at the rates of the mechanism without play."""
        return np.array([0.0, self.crank + self.rod, -self.rate * self.crank / self.rod, 0.0])


class Contact(NamedTuple):
    """Radial clearance [m], stiffness [N/m^1.5], and what is lost: chi [s/m], or a coefficient of restitution."""

    radial: float | np.ndarray
    stiffness: float
    damping: float = 0.0
    restitution: float | None = None

    def chi(self, approach: float) -> float:
        """chi [s/m] of a contact that began at a speed [m/s]."""
        return self.damping if self.restitution is None else 0.75 * (1.0 - self.restitution**2) / approach

    def normal_force(self, depth, rate, chi):
        """Normal force [N] at a penetration [m] that grows at a rate [m/s]."""
        return self.stiffness * np.maximum(depth, 0.0) ** 1.5 * np.maximum(1.0 + chi * rate, 0.0)


class Impact(NamedTuple):
    """One contact: times of its begin and end [s], speed at its begin [m/s], largest force [N] and its time [s]."""

    begin: float
    end: float
    approach: float
    peak: float
    peak_time: float


def penetration(crank: Crank, contact: Contact, t, y):
    """Penetration [m], its rate [m/s], and the unit vector from the bush's middle to the pin."""
    theta, s, rate, speed = y
    phi, w = crank.rate * t, crank.rate
    e = np.array([crank.crank * np.cos(phi) + crank.rod * np.cos(theta) - s,
                  crank.crank * np.sin(phi) + crank.rod * np.sin(theta)])  # fmt: skip
    velocity = np.array([-w * crank.crank * np.sin(phi) - rate * crank.rod * np.sin(theta) - speed,
                         w * crank.crank * np.cos(phi) + rate * crank.rod * np.cos(theta)])  # fmt: skip
    distance = np.sqrt(np.sum(e**2, axis=0))
    n = e / np.maximum(distance, 1e-30)
    return distance - contact.radial, np.sum(n * velocity, axis=0), n


def rates(crank: Crank, contact: Contact, t, y, chi):
    """y' and the normal force [N]; `chi` None: without contact."""
    theta, _, rate, speed = y
    phi = crank.rate * t
    if chi is None:
        force, n = 0.0 * theta, np.zeros((2, *np.shape(theta)))
    else:
        depth, depth_rate, n = penetration(crank, contact, t, y)
        force = contact.normal_force(depth, depth_rate, chi)
    centripetal = crank.rate**2 * crank.crank
    across = -np.sin(theta), np.cos(theta)
    weight = across[0] * centripetal * np.cos(phi) + across[1] * (GRAVITY + centripetal * np.sin(phi))
    moment = crank.mass * crank.centre * weight - crank.rod * force * (across[0] * n[0] + across[1] * n[1])
    turning = moment / (crank.inertia + crank.mass * crank.centre**2)
    return np.array([rate, speed, turning, force * n[0] / crank.slider]), force


def first_impacts(crank: Crank, contact: Contact, duration: float, tolerance: float = 1e-11) -> list[Impact]:
    """The contacts that begin before `duration` [s], each integration ending where a contact begins or ends.

    `tolerance`: relative; absolute ones are smaller by 1e3. Steps within contact are at most 2 us.
    """
    found, t, y = [], 0.0, crank.start()
    scale = 1e-3 * tolerance * np.array([1.0, 0.1, crank.rate, 0.1 * crank.rate])

    def depth(t, y):
        return penetration(crank, contact, t, y)[0]

    def go(chi, direction, longest):
        def passed(t, y):
            return depth(t, y)

        passed.terminal, passed.direction = True, direction  # pyright: ignore[reportFunctionMemberAccess]
        return solve_ivp(lambda t, y: rates(crank, contact, t, y, chi)[0], (t, t + duration), y, method="DOP853",
                         rtol=tolerance, atol=scale, events=passed, max_step=longest, dense_output=True)  # fmt: skip

    while True:
        free = go(None, 1.0, 2e-5)
        t, y = free.t[-1], free.y[:, -1]
        if t >= duration:
            return found
        approach = float(penetration(crank, contact, t, y)[1])
        chi = contact.chi(approach)
        closed = go(chi, -1.0, 2e-6)
        force = [rates(crank, contact, a, b, chi)[1] for a, b in zip(closed.t, closed.y.T, strict=True)]
        at = int(np.clip(np.argmax(force), 1, len(force) - 2))
        best = minimize_scalar(lambda t: -rates(crank, contact, t, closed.sol(t), chi)[1], method="bounded",
                               bounds=(closed.t[at - 1], closed.t[at + 1]), options={"xatol": 1e-12})  # fmt: skip
        found.append(Impact(t, closed.t[-1], approach, -best.fun, best.x))
        t, y = closed.t[-1], closed.y[:, -1]


class Histories(NamedTuple):
    """Many runs: times (T,) [s]; penetration [m], normal force [N], its square integrated from the start [N^2 s], each
    (T, runs)."""

    times: np.ndarray
    depth: np.ndarray
    force: np.ndarray
    square: np.ndarray


def batch(crank: Crank, contact: Contact, duration: float, interval: float = 2e-6, fine: int = 8) -> Histories:
    """Runs with clearances (runs,) and a given chi from the same start, recorded after every interval [s].

    A run takes an interval in one step where it cannot touch within it, and in `fine` steps elsewhere.
    """
    count, runs = round(duration / interval), np.size(contact.radial)
    y = np.repeat(crank.start()[:, None], runs, axis=1)
    square, chi, found = np.zeros(runs), contact.damping, []
    for n in range(count + 1):
        t = n * interval
        depth, rate, _ = penetration(crank, contact, t, y)
        found.append((depth, contact.normal_force(depth, rate, chi), square.copy()))
        near = depth + 2.0 * interval * np.abs(rate) > -1e-3 * contact.radial
        away = np.flatnonzero(~near)
        y[:, away], _ = _step(crank, contact, t, interval, y[:, away], None)
        near = np.flatnonzero(near)
        close, h = contact._replace(radial=np.asarray(contact.radial)[near]), interval / fine
        for k in range(fine if near.size else 0):
            y[:, near], gained = _step(crank, close, t + k * h, h, y[:, near], chi)
            square[near] += gained
    return Histories(interval * np.arange(count + 1), *(np.array(part) for part in zip(*found, strict=True)))


def _step(crank: Crank, contact: Contact, t: float, h: float, y, chi):
    """y after a step of Runge-Kutta 4, and the integral of the squared force over it."""
    k1, f1 = rates(crank, contact, t, y, chi)
    k2, f2 = rates(crank, contact, t + 0.5 * h, y + 0.5 * h * k1, chi)
    k3, f3 = rates(crank, contact, t + 0.5 * h, y + 0.5 * h * k2, chi)
    k4, f4 = rates(crank, contact, t + h, y + h * k3, chi)
    squares = f1**2 + 2.0 * f2**2 + 2.0 * f3**2 + f4**2
    return y + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4), h / 6.0 * squares

"""Motion of a slider-crank with an elastic connecting rod by assumed modes in the frame of the rod's chord.

Place in the pipeline: an independent value for `flexible_slider_crank`; it shares nothing with the rigid finite element
method.

Euler-Bernoulli rod of length L between the crank pin p(t), which turns at a constant rate, and the slider on the x
axis; e_t along the chord, at the angle phi from the x axis to the y axis, e_n across. The point x of the rod is at
p + (x + u) e_t + w e_n with w = sum_i q_i sin(i pi x / L) and u by given functions, u(0) = 0, and its acceleration is

    p'' + [u'' - phi'' w - 2 phi' w' - phi'^2 (x + u)] e_t + [w'' + phi'' (x + u) + 2 phi' u' - phi'^2 w] e_n.

Lagrange's equations of the first kind for (phi, q_w, q_u) with the slider's line as their constraint, strain
u_x + w_x^2 / 2 or, linear, u_x alone.  B. Simeon, "Modelling a flexible slider crank mechanism by a mixed system of
DAEs and PDEs", Math. Modelling of Systems 2 (1996) 1-18, derives them so.
"""

from dataclasses import dataclass
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfem_jax.kernels import kernel

Vector = Float[Array | np.ndarray, " n"]
NODES = 40  # of Gauss's quadrature


@dataclass(frozen=True)
class Rod:
    """Rod, crank and slider: lengths [m], rate [rad/s], line density [kg/m], inertia of the rigid rod about the pin
    [kg m^2], stiffnesses [N, N m^2], mass of the slider [kg].

    lateral: number of sines; along: "quadratic" (two functions of a finite element) or a number of sines beside x / L;
    along_mass: factor of the inertia of the displacements along the rod; stiffening: whether the strain has w_x^2 / 2.
    """

    crank: float
    length: float
    rate: float
    density: float
    inertia: float
    axial: float
    bending: float
    slider: float
    lateral: int = 2
    along: str | int = "quadratic"
    along_mass: float = 1.0
    stiffening: bool = False

    @cached_property
    def _points(self) -> tuple[Vector, Vector]:
        nodes, weights = np.polynomial.legendre.leggauss(NODES)
        return 0.5 * (nodes + 1.0), 0.5 * self.length * weights

    @cached_property
    def _lateral(self) -> Float[np.ndarray, "2 n points"]:
        """Sines, and their derivatives along x."""
        k = np.pi * np.arange(1, self.lateral + 1)[:, None]
        s = self._points[0]
        return np.stack([np.sin(k * s), k / self.length * np.cos(k * s)])

    @cached_property
    def _along(self) -> Float[np.ndarray, "2 n points"]:
        """Functions of u, the last one alone at the end, and their derivatives along x."""
        s, length = self._points[0], self.length
        if self.along == "quadratic":
            return np.array([[4 * s * (1 - s), s * (2 * s - 1)], [4 * (1 - 2 * s) / length, (4 * s - 1) / length]])
        k = np.pi * np.arange(1, int(self.along) + 1)[:, None]
        values = np.concatenate([np.sin(k * s), s[None]])
        return np.stack([values, np.concatenate([k * np.cos(k * s), np.ones_like(s)[None]]) / length])

    @cached_property
    def _integrals(self) -> dict[str, np.ndarray]:
        s, weights = self._points
        (w, _), (u, u_x) = self._lateral, self._along
        wave = np.pi * np.arange(1, self.lateral + 1) / self.length
        rho = self.density
        return {
            "ww": rho * (w * weights) @ w.T, "uu": self.along_mass * rho * (u * weights) @ u.T,
            "wu": rho * (w * weights) @ u.T, "w": rho * w @ weights, "u": rho * u @ weights,
            "xw": rho * w @ (weights * s * self.length), "xu": rho * u @ (weights * s * self.length),
            "bending": np.diag(self.bending * wave**4 * self.length / 2.0),
            "axial": self.axial * (u_x * weights) @ u_x.T,
        }  # fmt: skip

    def _elastic(self, q_w: Vector, q_u: Vector) -> tuple[Vector, Vector]:
        """Forces of the strains on q_w and q_u, with the opposite sign."""
        i = self._integrals
        if not self.stiffening:
            return i["bending"] @ q_w, i["axial"] @ q_u
        (_, w_x), (_, u_x), weights = self._lateral, self._along, self._points[1]
        slope = q_w @ w_x
        force = self.axial * (q_u @ u_x + 0.5 * slope**2) * weights
        return i["bending"] @ q_w + w_x @ (force * slope), u_x @ force

    def acceleration(self, t: Vector, position: Vector, rates: Vector) -> Vector:
        """Second derivatives of (phi, q_w, q_u)."""
        i, n = self._integrals, self.lateral
        phi, q_w, q_u = position[0], position[1 : 1 + n], position[1 + n :]
        spin, v_w, v_u = rates[0], rates[1 : 1 + n], rates[1 + n :]
        along, across = jnp.stack([jnp.cos(phi), jnp.sin(phi)]), jnp.stack([-jnp.sin(phi), jnp.cos(phi)])
        pin = -self.crank * self.rate**2 * jnp.stack([jnp.cos(self.rate * t), jnp.sin(self.rate * t)])
        a_t, a_n = pin @ along, pin @ across
        first = self.density * self.length**2 / 2.0
        u_moment, w_moment = i["uu"] @ q_u, i["ww"] @ q_w
        inertia = self.inertia + 2.0 * i["xu"] @ q_u + q_u @ u_moment + q_w @ w_moment
        coupling = jnp.concatenate([i["xw"] + i["wu"] @ q_u, -i["wu"].T @ q_w])
        mass = jnp.asarray(self._elastic_mass).at[0].set(jnp.append(inertia, coupling)).at[1:, 0].set(coupling)
        of_w, of_u = self._elastic(q_w, q_u)
        turning = a_t * (i["w"] @ q_w) - a_n * (first + i["u"] @ q_u)
        load = jnp.concatenate([
            (turning - 2.0 * spin * ((i["xu"] + u_moment) @ v_u + w_moment @ v_w))[None],
            -i["w"] * a_n - 2.0 * spin * i["wu"] @ v_u + spin**2 * w_moment - of_w,
            -i["u"] * a_t + 2.0 * spin * i["wu"].T @ v_w + spin**2 * (i["xu"] + u_moment) - of_u,
        ])  # fmt: skip
        # The end, with the slider: derivatives of its place (x, y), and what its acceleration has beside them.
        reach, size = self.length + q_u[-1], position.shape[0]
        rows = jnp.zeros((2, size)).at[:, 0].set(reach * across).at[:, -1].set(along)
        rest = pin + 2.0 * spin * v_u[-1] * across - spin**2 * reach * along
        mass = mass + self.slider * jnp.outer(rows[0], rows[0])
        load = load - self.slider * rows[0] * rest[0]
        held = jnp.append(rows[1], 0.0)
        system = jnp.concatenate([jnp.concatenate([mass, rows[1][:, None]], axis=1), held[None]])
        return jnp.linalg.solve(system, jnp.append(load, -rest[1]))[:size]

    @cached_property
    def _elastic_mass(self) -> np.ndarray:
        i, n = self._integrals, self.lateral
        mass = np.zeros((1 + n + len(i["u"]),) * 2)
        mass[1 : 1 + n, 1 : 1 + n], mass[1 + n :, 1 + n :] = i["ww"], i["uu"]
        return mass

    def motion(self, position: Vector, rates: Vector, duration: float, saved: int, steps: int) -> np.ndarray:
        """(phi, q_w, q_u) at `saved` + 1 times (saved + 1, n) from a start at 0, by `steps` steps of Runge-Kutta 4 in
        each interval."""
        size, h = len(position), duration / (saved * steps)

        def derivative(t, y):
            return jnp.concatenate([y[size:], self.acceleration(t, y[:size], y[size:])])

        def step(i, carry):
            t, y = carry
            a = derivative(t, y)
            b = derivative(t + 0.5 * h, y + 0.5 * h * a)
            c = derivative(t + 0.5 * h, y + 0.5 * h * b)
            d = derivative(t + h, y + h * c)
            return t + h, y + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)

        def interval(carry, _):
            carry = jax.lax.fori_loop(0, steps, step, carry)
            return carry, carry[1][:size]

        start = jnp.zeros(()), jnp.concatenate([jnp.asarray(position), jnp.asarray(rates)])
        _, found = kernel(lambda carry: jax.lax.scan(interval, carry, length=saved))(start)
        return np.concatenate([np.asarray(position)[None], found])

    def slider_place(self, t: Vector, phi: Vector, end: Vector) -> Vector:
        """Distance [m] of the slider from the crank's axis; end: u there [m]."""
        return self.crank * np.cos(self.rate * t) + (self.length + end) * np.cos(phi)

    def deflection(self, q_w: Float[np.ndarray, "times n"], share: float = 0.5) -> Vector:
        """Lateral deflection [m] at a share of the length."""
        return q_w @ np.sin(np.pi * share * np.arange(1, self.lateral + 1))

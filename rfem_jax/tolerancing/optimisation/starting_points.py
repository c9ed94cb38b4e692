"""Tolerance regions in standard coordinates, and points to start searches from.

Place in the pipeline: under worst cases and allocation.

    e = centre + M z       box: |z_i| <= 1, M = diag(t);   ellipsoid: |z| <= 1, M = diag(t) chol(C)
                           balls: |z_b| <= 1 for every block b, M that of the zones beside diag(t)

A box with tolerance zones in it is a product of balls, given by their dimensions: 1 for an error of its own, 2 for the
disc of a position.

Symbols: z (k,) standard coordinates, e (k,) errors [rad, m], t (k,) half-widths, C (k, k) correlation of the errors
(so the ellipsoid touches the box's faces), g, H a quadratic model in z.

A search must not start at the symmetric point, where gradients of even metrics vanish: the starts are corners by the
signs of the Hessian's eigenvectors and the maxima of the quadratic model, random points, and scrambled Sobol' points.
"""

from collections.abc import Callable, Mapping
from functools import cache, partial
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.stats import chi, norm, qmc

from rfem_jax.description.basics.errors import InputError, require_choice
from rfem_jax.tolerancing.checks import ErrorValues
from rfem_jax.tolerancing.optimisation.projected_gradient import Point, climb, project_ball, project_box
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances
from rfem_jax.tolerancing.sampling.sequences import RandomKey

REGIONS = ("box", "ellipsoid")
KINDS = ("corners", "random", "sobol")
EXHAUSTIVE = 12  # 2^12 corners are still few
SEEDS = 64

Region = str | tuple[int, ...]  # "box", "ellipsoid", or the dimensions of balls
Expansion = tuple[float, Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]  # value, gradient, Hessian in z

_project_unit_box = partial(project_box, lower=-1.0, upper=1.0)


def region_of(region: str, tolerances: Tolerances | ErrorValues) -> Region:
    """The region that a search goes over: a box with zones is a product of balls. Raises: InputError."""
    require_choice(region, REGIONS, "region")
    if region == "ellipsoid" or not isinstance(tolerances, Tolerances) or not tolerances.zones:
        return region
    alone = len(tolerances.names) - sum(len(zone.names) for zone in tolerances.zones)
    return (1,) * alone + tuple(n for zone in tolerances.zones for n in zone.balls)


def region_matrix(
    region: str, tolerances: Tolerances | ErrorValues, half_widths: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "k k"]:
    """M (k, k) of e = centre + M z.

    Args: region "box" or "ellipsoid"; tolerances, a collection or a mapping as for `worst_case`; half_widths (k,) of
        the same errors.
    Raises: InputError for an unknown region and a covariance that is not positive definite.
    """
    require_choice(region, REGIONS, "region")
    if not isinstance(tolerances, Tolerances):
        return np.diag(half_widths)
    if region == "box":
        matrix = np.diag(half_widths)
        first = len(half_widths)
        for zone in reversed(tolerances.zones):
            block = slice(first - len(zone.names), first)
            matrix[block, block] = np.asarray(zone.matrix)
            first = block.start
        return matrix
    covariance = np.asarray(tolerances.covariance(), dtype=np.float64)
    deviation = np.sqrt(np.diag(covariance))
    try:
        root = np.linalg.cholesky(covariance / np.outer(deviation, deviation))
    except np.linalg.LinAlgError:
        raise InputError(
            "Argument `tolerances` must have a positive definite covariance for an ellipsoid, but theirs is not; "
            "remove an error that the others determine."
        ) from None
    return half_widths[:, None] * root


def projection(region: Region) -> Callable[[Point], Point]:
    """Function z -> nearest z of the region; the same object each time (it keys programs)."""
    if isinstance(region, tuple):
        return _project_balls(region)
    return project_ball if region == "ellipsoid" else _project_unit_box


@cache
def _project_balls(dimensions: tuple[int, ...]) -> Callable[[Point], Point]:
    blocks = np.cumsum(dimensions)[:-1]
    return lambda z: jnp.concatenate([project_ball(part) for part in jnp.split(z, blocks)])


def box_corners(k: int) -> Float[np.ndarray, "corners k"]:
    """All corners (2^k, k) of the box, in the order of binary numbers."""
    return np.array(list(product((-1.0, 1.0), repeat=k)))


def seed_of(key: RandomKey) -> int:
    """An integer seed for SciPy from a JAX key."""
    return int(jax.random.bits(key, dtype=jnp.uint32))


def sobol_units(k: int, count: int, key: RandomKey) -> Float[np.ndarray, "count k"]:
    """Scrambled Sobol' points (count, k) in the unit cube, open at both ends."""
    generator = qmc.Sobol(k, scramble=True, rng=np.random.default_rng(seed_of(key)))
    points = generator.random_base2(max(0, int(np.ceil(np.log2(max(count, 1))))))[:count]
    return np.clip(points, 1e-12, 1 - 1e-12)


def spread_points(units: Float[np.ndarray, "n columns"], region: Region) -> Float[np.ndarray, "n k"]:
    """Points of the region from points (n, k + 1) of the unit cube (a box does not use the last column)."""
    if region == "box":
        return 2 * units[:, :-1] - 1
    normals = norm.ppf(units[:, :-1])
    if isinstance(region, tuple):
        lengths = [np.linalg.norm(part, axis=1, keepdims=True) for part in _parts(normals, region)]
        radii = [chi.cdf(length, n) ** (1 / n) / length for n, length in zip(region, lengths, strict=True)]
        return normals * np.repeat(np.concatenate(radii, axis=1), region, axis=1)
    radius = units[:, -1:] ** (1 / (units.shape[1] - 1))
    return radius * normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _parts(array: np.ndarray, region: tuple[int, ...]) -> list[np.ndarray]:
    """The columns of each ball."""
    return np.split(array, np.cumsum(region)[:-1], axis=-1)


@partial(jax.jit, static_argnames=("region",))
def _climb_quadratic(gradient, hessian, starts, scale, region):
    def function(z):
        curved = hessian @ z
        return (gradient @ z + 0.5 * z @ curved) / scale, (gradient + curved) / scale

    return jax.vmap(lambda z: climb(function, projection(region), z, evaluations=500))(starts)


def maximise_quadratic(
    value: float,
    gradient: Float[np.ndarray, " k"],
    hessian: Float[np.ndarray, "k k"],
    region: Region,
    key: RandomKey,
) -> tuple[Float[np.ndarray, "p k"], Float[np.ndarray, " p"]]:
    """Local maxima of value + g.z + 1/2 z^T H z over the region, best first.

    Args: value, gradient (k,), hessian (k, k), in z; key of the random seeds.
    Returns: points (p, k), distinct, and their values (p,). For a box with k <= EXHAUSTIVE the best corners are among
        the seeds, so the best corner is never missed; otherwise the best found.
    """
    k = len(gradient)
    if not (np.isfinite(value) and np.all(np.isfinite(gradient)) and np.all(np.isfinite(hessian))):
        return np.zeros((0, k)), np.zeros(0)
    vectors = np.linalg.eigh(hessian)[1].T
    units = sobol_units(k + 1, SEEDS, key)
    seeds = [np.sign(vectors), -np.sign(vectors), vectors, -vectors]
    seeds += [np.sign(gradient)[None], spread_points(units, region), np.sign(units[:, :-1] - 0.5)]
    if region == "box" and k <= EXHAUSTIVE:
        corners = box_corners(k)
        heights = corners @ gradient + 0.5 * np.einsum("ni,ij,nj->n", corners, hessian, corners)
        seeds.append(corners[np.argsort(-heights, kind="stable")[:8]])
    scale = max(np.abs(gradient).sum() + 0.5 * np.abs(hessian).sum(), 1e-300)
    arrays = map(jnp.asarray, (gradient, hessian, np.concatenate(seeds)))
    search = _climb_quadratic(*arrays, scale, region)
    points, heights = np.asarray(search.point), np.asarray(search.value) * scale
    chosen = distinct(points, heights)
    return points[chosen], value + heights[chosen]


def quadratic_bound(
    value: float, gradient: Float[np.ndarray, " k"], hessian: Float[np.ndarray, "k k"], region: Region
) -> float:
    """An upper bound of the quadratic model over the region (z coordinates), in closed form (theory (10.11)).

    Box: value + sum|g| + 1/2 sum|H|; ellipsoid: value + |g| + 1/2 max(0, largest eigenvalue); balls: |g_b| and the
    spectral norms |H_ab| of the blocks in the place of |g_i| and |H_ij|.
    """
    if isinstance(region, tuple):
        slopes = sum(float(np.linalg.norm(part)) for part in _parts(gradient, region))
        blocks = [block for rows in _parts(hessian, region) for block in _parts(rows.T, region)]
        finite = np.all(np.isfinite(hessian))
        curved = sum(float(np.linalg.norm(block, 2)) for block in blocks) if finite else np.nan
        return float(value + slopes + 0.5 * curved)
    if region == "box":
        return float(value + np.abs(gradient).sum() + 0.5 * np.abs(hessian).sum())
    largest = np.linalg.eigvalsh(hessian)[-1] if np.all(np.isfinite(hessian)) else np.nan
    return float(value + np.linalg.norm(gradient) + 0.5 * max(0.0, largest))


def distinct(
    points: Float[np.ndarray, "n k"], values: Float[np.ndarray, " n"], distance: float = 1e-3
) -> Int[np.ndarray, " kept"]:
    """Indices of the points (n, k) that differ from every better one, best value first; none with value NaN."""
    kept: list[int] = []
    for i in np.argsort(-values, kind="stable"):
        if np.isfinite(values[i]) and (np.abs(points[kept] - points[i]).max(axis=1, initial=0.0) > distance).all():
            kept.append(i)
    return np.array(kept, dtype=int)


def start_points(
    counts: Mapping[str, int], model: Expansion | None, region: Region, k: int, key: RandomKey
) -> Float[np.ndarray, "starts k"]:
    """Starts (n, k) of a search in z; `counts` {"corners": n, "random": n, "sobol": n} of each kind.

    Args: model (value, gradient, Hessian) in z or None; key of the random points. "corners" are the maxima of the
        quadratic model; where it has fewer (or there is no model), corners with random signs are added, on an
        ellipsoid points of its surface.
    Raises: InputError for an unknown kind, a negative number or no start at all.
    """
    for kind, count in counts.items():
        if kind not in KINDS or count != int(count) or count < 0:
            raise InputError(
                f"Argument `starts` must give whole numbers of {', '.join(KINDS)}, but has {kind!r}: {count!r}."
            )
    if sum(counts.values()) < 1:
        raise InputError("Argument `starts` must ask for at least one start, but asks for none.")
    keys = jax.random.split(key, 4)
    maxima = np.zeros((0, k)) if model is None else maximise_quadratic(*model, region, keys[0])[0]
    maxima = maxima[: counts.get("corners", 0)]
    missing = counts.get("corners", 0) - len(maxima)
    signs = np.asarray(jax.random.rademacher(keys[1], (missing, k), dtype=jnp.float64))
    fill = signs if region == "box" else signs / np.sqrt(np.repeat(region, region) if isinstance(region, tuple) else k)
    random = np.asarray(jax.random.uniform(keys[2], (counts.get("random", 0), k + 1)))
    sobol = sobol_units(k + 1, counts.get("sobol", 0), keys[3])
    spread = spread_points(np.clip(np.concatenate([random, sobol]), 1e-12, 1 - 1e-12), region)
    return np.concatenate([maxima, fill, spread])

"""Finite elements of the rocker by scikit-fem: hexahedra of second order with 27 nodes, isotropic and elastic.

Units: m, kg, s.  Rows of matrices are displacements along x, y and z of one node after the other.
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array, csr_array
from skfem import Basis, ElementHex2, FacetBasis, MeshHex, MeshHex2

STEEL = (210e9, 0.3, 7850.0)  # Young's modulus [Pa], Poisson's ratio, density [kg/m^3]
SHEARS = ((0, 1), (1, 2), (2, 0))  # xy, yz, zx


class Solid(NamedTuple):
    """A mesh with its matrices: basis of scikit-fem; places of nodes (p, 3); mass and stiffness (3 p, 3 p)."""

    basis: Basis
    nodes: np.ndarray
    mass: csr_array
    stiffness: csr_array


def thickened(plane: list[np.ndarray], layers: int, thickness: float) -> MeshHex2:
    """The mesh of blocks of points (2 a + 1, 2 b + 1, 2) in the plane x, z, with `layers` elements along y."""
    y = np.linspace(0.5 * thickness, -0.5 * thickness, 2 * layers + 1)  # x, z, -y are right-handed
    local = np.rint(2.0 * ElementHex2().doflocs).astype(int)  # of the nodes of an element, in thirds of its points
    own, corners = [], MeshHex.init_refdom().p.T.astype(int) * 2
    for block in plane:
        grid = np.empty((*block.shape[:2], len(y), 3))
        grid[..., 0], grid[..., 1], grid[..., 2] = block[..., None, 0], y, block[..., None, 1]
        starts = np.stack(np.meshgrid(*(np.arange(0, size - 1, 2) for size in grid.shape[:3]), indexing="ij"), axis=-1)
        at = starts.reshape(-1, 1, 3) + local
        own.append(grid[at[..., 0], at[..., 1], at[..., 2]])
    points = np.concatenate(own)  # (elements, 27, 3)
    at_corner = [int(np.flatnonzero((local == corner).all(axis=1))[0]) for corner in corners]
    vertices = points[:, at_corner].reshape(-1, 3)
    _, first, number = np.unique(np.round(vertices, 9), axis=0, return_index=True, return_inverse=True)
    mesh = MeshHex2.from_mesh(MeshHex(vertices[first].T, number.reshape(-1, 8).T))
    places = mesh.doflocs.copy()
    places[:, mesh.dofs.element_dofs] = points.transpose(2, 1, 0)
    return MeshHex2(places, mesh.t)


def solid(mesh: MeshHex2, material=STEEL) -> Solid:
    """Assemble the consistent mass and the stiffness of a mesh."""
    modulus, poisson, density = material
    shear, lame = 0.5 * modulus / (1.0 + poisson), modulus * poisson / (1.0 + poisson) / (1.0 - 2.0 * poisson)
    basis = Basis(mesh, ElementHex2(), intorder=5)
    values = np.stack([np.asarray(one[0]) for one in basis.basis])
    slopes = np.stack([one[0].grad for one in basis.basis])  # (27, 3, elements, points)
    between = np.einsum("iaeq,jbeq,eq->eiajb", slopes, slopes, basis.dx, optimize=True)
    alike = np.einsum("eicjc->eij", between)
    own = lame * between + shear * between.swapaxes(2, 4)
    own += shear * alike[:, :, None, :, None] * np.eye(3)[:, None]
    mass = density * np.einsum("ieq,jeq,eq->eij", values, values, basis.dx, optimize=True)
    masses = mass[:, :, None, :, None] * np.eye(3)[:, None]
    rows = 3 * basis.element_dofs.T[:, :, None] + np.arange(3)
    count = 3 * basis.N
    place = np.broadcast_arrays(rows[:, :, :, None, None], rows[:, None, None])
    place = tuple(one.reshape(-1) for one in place)
    matrices = (csr_array(coo_array((one.reshape(-1), place), shape=(count, count))) for one in (masses, own))
    return Solid(basis, basis.doflocs.T, *matrices)


def stress_rows(body: Solid, material=STEEL) -> csr_array:
    """Stresses xx, yy, zz, xy, yz, zx at all nodes by their displacements (6 p, 3 p): averages over the elements of a
    node."""
    modulus, poisson, _ = material
    shear, lame = 0.5 * modulus / (1.0 + poisson), modulus * poisson / (1.0 + poisson) / (1.0 - 2.0 * poisson)
    corners = ElementHex2().doflocs.T
    basis = Basis(body.basis.mesh, ElementHex2(), quadrature=(corners, np.ones(corners.shape[1])))
    slopes = np.stack([one[0].grad for one in basis.basis])  # (27, 3, elements, 27): of function i at node q
    own = np.zeros((6, 27, 3, *slopes.shape[2:]))  # of the component, by displacement a of node i
    own[:3] += lame * slopes
    for a in range(3):
        own[a, :, a] += 2.0 * shear * slopes[:, a]
    for row, (a, b) in enumerate(SHEARS, start=3):
        own[row, :, a] += shear * slopes[:, b]
        own[row, :, b] += shear * slopes[:, a]
    nodes = basis.element_dofs
    own /= np.bincount(nodes.reshape(-1))[nodes.T]
    rows = 6 * nodes.T + np.arange(6)[:, None, None, None, None]
    columns = 3 * nodes[:, None, :, None] + np.arange(3)[:, None, None]
    place = tuple(one.reshape(-1) for one in np.broadcast_arrays(rows, columns))
    return csr_array(coo_array((own.reshape(-1), place), shape=(6 * basis.N, 3 * basis.N)))


def bore_of(body: Solid, middle: float, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Nodes of a bore along y, and the area that each one stands for."""
    mesh = body.basis.mesh.translated((-middle, 0.0, 0.0))  # where places on its faces are found to the last digit
    at = mesh.doflocs[:, mesh.facets]  # (3, 4, facets)
    inside = np.abs(np.hypot(at[0], at[2]) - radius) < 1e-9
    facets = np.intersect1d(np.flatnonzero(inside.all(axis=0)), mesh.boundary_facets())
    bore = FacetBasis(mesh, ElementHex2(), facets=facets, intorder=5)
    areas = np.zeros(bore.N)
    for i, function in enumerate(bore.basis):
        np.add.at(areas, bore.element_dofs[i], (np.asarray(function[0]) * bore.dx).sum(axis=-1))
    nodes = np.flatnonzero(np.abs(np.hypot(body.nodes[:, 0] - middle, body.nodes[:, 2]) - radius) < 1e-9)
    return nodes, areas[nodes]

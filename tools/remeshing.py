"""Triangle mesh surgery for the asset scripts: quadric decimation, isotropic remeshing, mirroring and clipping.

Both algorithms work on one half of a mirror-symmetric mesh (x >= 0) whose boundary on the plane x = 0 stays there, so
that `mirror` gives back a mesh whose left and right are the same to the last bit.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable

import numpy as np

__all__ = ["Surgery", "clip", "compact", "decimate", "mirror", "remesh", "triangle_quality", "vertex_normals"]


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted unit normals (V, 3)."""
    t = vertices[faces]
    n = np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])
    out = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(out, faces[:, k], n)
    return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-30)


def triangle_quality(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smallest angle of every face in degrees, and the lengths of the unique edges in metres."""
    t = vertices[faces]
    angles = []
    for k in range(3):
        u, v = t[:, (k + 1) % 3] - t[:, k], t[:, (k + 2) % 3] - t[:, k]
        angles.append(np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), (u * v).sum(1)))
    edges = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    lengths = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    return np.degrees(np.min(angles, axis=0)), lengths


def compact(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Drop vertices that no face uses."""
    used, index = np.unique(faces, return_inverse=True)
    return vertices[used], index.reshape(faces.shape).astype(np.int32)


def mirror(vertices: np.ndarray, faces: np.ndarray, tolerance: float = 1e-7) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weld a half mesh (x >= 0) to its mirror image; also returns, per new vertex, the half's vertex it came from."""
    vertices = vertices.copy()
    seam = np.abs(vertices[:, 0]) < tolerance
    vertices[seam, 0] = 0.0
    twin = np.arange(len(vertices))
    twin[~seam] = len(vertices) + np.arange((~seam).sum())
    out = np.concatenate([vertices, vertices[~seam] * [-1.0, 1.0, 1.0]])
    source = np.concatenate([np.arange(len(vertices)), np.flatnonzero(~seam)])
    return out, np.concatenate([faces, twin[faces][:, ::-1]]).astype(np.int32), source


def clip(vertices: np.ndarray, faces: np.ndarray, field: np.ndarray, snap: float = 1e-9) -> tuple[np.ndarray, np.ndarray]:
    """Keep the part of a mesh where the per-vertex field is >= 0, cutting faces along the linear zero."""
    field = np.where(np.abs(field) < snap, 0.0, field)
    points, cuts, out = list(vertices), {}, []

    def cut(a: int, b: int) -> int:
        key = (a, b) if a < b else (b, a)
        if key not in cuts:
            fa, fb = field[key[0]], field[key[1]]
            s = fa / (fa - fb)
            points.append(vertices[key[0]] * (1 - s) + vertices[key[1]] * s)
            cuts[key] = len(points) - 1
        return cuts[key]

    for f in faces:
        polygon = []
        for a, b in zip(f, np.roll(f, -1), strict=True):
            if field[a] >= 0:
                polygon.append(int(a))
            if (field[a] > 0 > field[b]) or (field[a] < 0 < field[b]):
                polygon.append(cut(int(a), int(b)))
        if len(polygon) >= 3 and any(field[v] > 0 for v in f):
            out += [[polygon[0], polygon[i], polygon[i + 1]] for i in range(1, len(polygon) - 1)]
    return compact(np.array(points), np.array(out))


class Surgery:
    """A triangle mesh that can be edited one edge at a time."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        self.points = [np.array(p, dtype=float) for p in vertices]
        self.faces: dict[int, tuple[int, int, int]] = {}
        self.star: list[set[int]] = [set() for _ in vertices]
        self._next = 0
        for f in faces:
            self._add(tuple(int(v) for v in f))

    def _add(self, f: tuple[int, ...]) -> None:
        self.faces[self._next] = f
        for v in f:
            self.star[v].add(self._next)
        self._next += 1

    def _remove(self, index: int) -> None:
        for v in self.faces.pop(index):
            self.star[v].discard(index)

    def ring(self, v: int) -> set[int]:
        """Neighbours of a vertex."""
        return {w for f in self.star[v] for w in self.faces[f]} - {v}

    def around(self, a: int, b: int) -> set[int]:
        """Faces on an edge."""
        return self.star[a] & self.star[b]

    def is_rim(self, v: int) -> bool:
        """Whether a vertex lies on the boundary."""
        return len(self.ring(v)) != len(self.star[v])

    def edges(self) -> list[tuple[int, int]]:
        """All edges, each once."""
        out = {(min(a, b), max(a, b)) for f in self.faces.values() for a, b in zip(f, f[1:] + f[:1], strict=True)}
        return sorted(out)

    def opposite(self, face: int, a: int, b: int) -> int:
        """The corner of a face that is not on the edge."""
        return next(v for v in self.faces[face] if v != a and v != b)

    def normal(self, f: tuple[int, ...], moved: dict[int, np.ndarray] | None = None) -> np.ndarray:
        """Unnormalised normal of a face, optionally with some corners elsewhere."""
        p, q, r = ((moved or {}).get(v, self.points[v]) for v in f)
        u, w = q - p, r - p
        return np.array([u[1] * w[2] - u[2] * w[1], u[2] * w[0] - u[0] * w[2], u[0] * w[1] - u[1] * w[0]])

    def may_collapse(self, a: int, b: int, target: np.ndarray, turn: float = 0.2, shape: float = 0.0) -> bool:
        """Link condition, no face turned over, no face worse than a quality limit."""
        shared = self.around(a, b)
        if not shared:
            return False
        corners = {self.opposite(f, a, b) for f in shared}
        if self.ring(a) & self.ring(b) != corners:
            return False
        if len(shared) == 2 and self.is_rim(a) and self.is_rim(b):
            return False
        if any(len(self.star[c]) <= 3 and not self.is_rim(c) for c in corners):
            return False
        for f in (self.star[a] | self.star[b]) - shared:
            corners_f = self.faces[f]
            old, new = self.normal(corners_f), self.normal(corners_f, {a: target, b: target})
            size = np.sqrt(new @ new)
            if old @ new <= turn * np.sqrt(old @ old) * size:
                return False
            p = [target if v in (a, b) else self.points[v] for v in corners_f]
            longest = max(((p[i] - p[i - 1]) ** 2).sum() for i in range(3))
            if size < shape * longest:
                return False
        return True

    def collapse(self, a: int, b: int, target: np.ndarray) -> None:
        """Merge b into a, placed at the target."""
        for f in self.around(a, b):
            self._remove(f)
        for f in list(self.star[b]):
            corners = tuple(a if v == b else v for v in self.faces[f])
            self._remove(f)
            self._add(corners)
        self.points[a] = target

    def split(self, a: int, b: int, target: np.ndarray) -> int:
        """Put a new vertex on an edge."""
        new = len(self.points)
        self.points.append(target)
        self.star.append(set())
        for f in list(self.around(a, b)):
            corners = self.faces[f]
            self._remove(f)
            self._add(tuple(new if v == b else v for v in corners))
            self._add(tuple(new if v == a else v for v in corners))
        return new

    def flip(self, a: int, b: int, turn: float = 0.3) -> bool:
        """Turn an inner edge if the result is a proper mesh that faces the same way."""
        shared = self.around(a, b)
        if len(shared) != 2:
            return False
        f, g = sorted(shared)
        corners = self.faces[f]
        i = corners.index(a)
        if corners[(i + 1) % 3] != b:
            f, g = g, f
        c, d = self.opposite(f, a, b), self.opposite(g, a, b)  # f = (a, b, c), g = (b, a, d)
        if c == d or self.around(c, d):
            return False
        old = self.normal(self.faces[f]) + self.normal(self.faces[g])
        one, two = (a, d, c), (d, b, c)
        for new in (self.normal(one), self.normal(two)):
            if old @ new <= turn * np.sqrt(old @ old) * np.sqrt(new @ new):
                return False
        self._remove(f)
        self._remove(g)
        self._add(one)
        self._add(two)
        return True

    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and faces, compacted."""
        return compact(np.array(self.points), np.array([self.faces[k] for k in sorted(self.faces)]))


def decimate(
    vertices: np.ndarray, faces: np.ndarray, importance: np.ndarray, target: int, evenness: float = 1e-4
) -> tuple[np.ndarray, np.ndarray]:
    """Quadric edge collapse (Garland and Heckbert 1997) of a half mesh, errors scaled by a per-vertex importance.

    `evenness` adds that multiple of (edge length)^2 x (area around) to an edge's cost, which keeps flat parts evenly
    meshed.
    """
    mesh = Surgery(vertices, faces)
    weight = list(importance.astype(float))
    quadrics = [np.zeros((4, 4)) for _ in vertices]
    area = np.zeros(len(vertices))
    for f in mesh.faces.values():
        n = mesh.normal(f)
        size = np.sqrt(n @ n)
        plane = np.append(n / size, -(n / size) @ mesh.points[f[0]])
        for v in f:
            quadrics[v] += np.outer(plane, plane) * size / 6
            area[v] += size / 6
    stamp = [0] * len(vertices)
    seam = [mesh.points[v][0] == 0.0 and mesh.is_rim(v) for v in range(len(vertices))]

    def candidate(a: int, b: int) -> tuple[float, int, int, int, int, np.ndarray]:
        q, pa, pb = quadrics[a] + quadrics[b], mesh.points[a], mesh.points[b]
        options = [pa, pb, (pa + pb) / 2]
        system, side = q[:3, :3] + 1e-3 * np.trace(q[:3, :3]) * np.eye(3), -q[:3, 3]
        options.append(options[2] + np.linalg.solve(system, side - q[:3, :3] @ options[2]))
        if seam[a] or seam[b]:
            options = [p * [0.0, 1.0, 1.0] for p in options]
        errors = [float(np.append(p, 1) @ q @ np.append(p, 1)) for p in options]
        best = int(np.argmin(errors))
        length = (pa - pb) @ (pa - pb)
        cost = max(weight[a], weight[b]) * (max(errors[best], 0.0) + evenness * length * (area[a] + area[b]))
        return cost, a, b, stamp[a], stamp[b], options[best]

    heap = [(c[0], i, c) for i, c in enumerate(candidate(a, b) for a, b in mesh.edges())]
    heapq.heapify(heap)
    alive, count = len(vertices), len(heap)
    while alive > target and heap:
        _, _, (_, a, b, sa, sb, point) = heapq.heappop(heap)
        if (sa, sb) != (stamp[a], stamp[b]) or not mesh.may_collapse(a, b, point, 0.3, 0.12):
            continue
        mesh.collapse(a, b, point)
        quadrics[a] += quadrics[b]
        area[a] += area[b]
        weight[a], seam[a] = max(weight[a], weight[b]), seam[a] or seam[b]
        stamp[a] += 1
        stamp[b] = -1
        alive -= 1
        for c in mesh.ring(a):
            count += 1
            item = candidate(a, c)
            heapq.heappush(heap, (item[0], count, item))
    return mesh.arrays()


def remesh(
    vertices: np.ndarray,
    faces: np.ndarray,
    edge: float,
    project: Callable[[np.ndarray], np.ndarray],
    curves: list[np.ndarray],
    rounds: int = 8,
) -> tuple[np.ndarray, np.ndarray]:
    """Isotropic remeshing (Botsch and Kobbelt 2004): split, collapse, flip, smooth in the surface, project.

    `curves` holds one array of points (N, 3) per boundary curve, in order; boundary vertices slide along their curve,
    and where two curves meet there is a fixed corner.
    """
    mesh = Surgery(vertices, faces)
    ends = np.array([c[i] for c in curves for i in (0, -1) if np.linalg.norm(c[0] - c[-1]) > 1e-9] or [[np.inf] * 3])

    def is_corner(v: int) -> bool:
        return bool((np.abs(ends - mesh.points[v]).max(1) < 1e-7).any())

    def curve_of(p: np.ndarray) -> int:
        return int(np.argmin([_to_polyline(p, c)[1] for c in curves]))

    label = {}
    for a, b in mesh.edges():
        if len(mesh.around(a, b)) == 1:
            label[a, b] = curve_of((mesh.points[a] + mesh.points[b]) / 2)

    for _ in range(rounds):
        for a, b in mesh.edges():  # split
            d = mesh.points[a] - mesh.points[b]
            if d @ d > (4 / 3 * edge) ** 2:
                middle = (mesh.points[a] + mesh.points[b]) / 2
                rim = label.pop((a, b), None)
                new = mesh.split(a, b, middle)
                if rim is not None:
                    mesh.points[new] = _to_polyline(middle, curves[rim])[0]
                    label[min(a, new), max(a, new)] = label[min(b, new), max(b, new)] = rim
        for v in range(len(mesh.points)):  # a vertex inside a triangle
            if len(mesh.star[v]) == 3 and not mesh.is_rim(v):
                keep = min(mesh.ring(v))
                if len(mesh.around(*(mesh.ring(v) - {keep}))) == 1:
                    mesh.collapse(keep, v, mesh.points[keep])
        for a, b in mesh.edges():  # collapse
            if not mesh.around(a, b):
                continue
            d = mesh.points[a] - mesh.points[b]
            if d @ d >= (4 / 5 * edge) ** 2:
                continue
            rim_a, rim_b = mesh.is_rim(a), mesh.is_rim(b)
            if is_corner(b) or (rim_b and not rim_a):
                a, b, rim_a, rim_b = b, a, rim_b, rim_a
            key = (min(a, b), max(a, b))
            if is_corner(b) or (rim_a and rim_b and key not in label):
                continue
            place = mesh.points[a] if rim_a else (mesh.points[a] + mesh.points[b]) / 2
            if rim_a and rim_b and not is_corner(a):
                place = _to_polyline((mesh.points[a] + mesh.points[b]) / 2, curves[label[key]])[0]
            others = (mesh.ring(a) | mesh.ring(b)) - {a, b}
            if any(((mesh.points[w] - place) ** 2).sum() > (4 / 3 * edge) ** 2 for w in others):
                continue
            if not mesh.may_collapse(a, b, place, 0.5):
                continue
            mesh.collapse(a, b, place)
            if rim_b:
                label.pop(key)
                for k in [k for k in label if b in k]:
                    w = k[0] if k[1] == b else k[1]
                    label[min(a, w), max(a, w)] = label.pop(k)
        _equalise(mesh)
        _relax(mesh, label, curves, is_corner, project)
    for _ in range(4):
        _equalise(mesh)
        _relax(mesh, label, curves, is_corner, project)
    for _ in range(3):
        _sharpen(mesh)
        _relax(mesh, label, curves, is_corner, project)
    _sharpen(mesh)
    return mesh.arrays()


def _sharpen(mesh: Surgery) -> None:
    """Flip edges where that opens the smallest angle (Delaunay)."""

    def apex(c: int, a: int, b: int) -> float:
        u, v = mesh.points[a] - mesh.points[c], mesh.points[b] - mesh.points[c]
        w = np.array([u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]])
        return float(np.arctan2(np.sqrt(w @ w), u @ v))

    for a, b in mesh.edges():
        shared = mesh.around(a, b)
        if len(shared) == 2:
            c, d = (mesh.opposite(f, a, b) for f in shared)
            if apex(c, a, b) + apex(d, a, b) > np.pi + 0.05:
                mesh.flip(a, b, 0.5)


def _equalise(mesh: Surgery) -> None:
    """Flip edges towards valence 6 (4 on the boundary)."""

    def excess(v: int, change: int) -> int:
        rim = mesh.is_rim(v)
        return (len(mesh.ring(v)) + change - (4 if rim else 6)) ** 2

    for a, b in mesh.edges():
        shared = mesh.around(a, b)
        if len(shared) != 2:
            continue
        c, d = (mesh.opposite(f, a, b) for f in shared)
        before = excess(a, 0) + excess(b, 0) + excess(c, 0) + excess(d, 0)
        after = excess(a, -1) + excess(b, -1) + excess(c, 1) + excess(d, 1)
        if after < before:
            mesh.flip(a, b, 0.6)


def _relax(mesh: Surgery, label: dict, curves: list, is_corner: Callable, project: Callable, steps: int = 3) -> None:
    """Move inner vertices to the area-weighted centre of their neighbours and boundary vertices along their curve."""
    live = [v for v in range(len(mesh.points)) if mesh.star[v]]
    rim: dict[int, list[tuple[int, int]]] = {}
    for (a, b), c in label.items():
        rim.setdefault(a, []).append((b, c))
        rim.setdefault(b, []).append((a, c))
    inner = [v for v in live if v not in rim]
    slide = [v for v in rim if not is_corner(v)]
    faces = np.array(list(mesh.faces.values()))
    points = np.array(mesh.points)
    for _ in range(steps):
        t = points[faces]
        size = np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1)
        total, mass = np.zeros_like(points), np.zeros(len(points))
        for k in range(3):
            np.add.at(total, faces[:, k], t.mean(1) * size[:, None])
            np.add.at(mass, faces[:, k], size)
        centre = total / np.maximum(mass, 1e-30)[:, None]
        normal = vertex_normals(points, faces)
        move = centre - points
        move -= normal * (move * normal).sum(1, keepdims=True)
        new = points.copy()
        new[inner] = project(points[inner] + 0.8 * move[inner])
        for v in slide:
            (p, c), (q, _) = rim[v]
            new[v] = _to_polyline((points[v] + (points[p] + points[q]) / 2) / 2, curves[c])[0]
        points = new
    mesh.points = list(points)


def _to_polyline(p: np.ndarray, curve: np.ndarray) -> tuple[np.ndarray, float]:
    """Nearest point of a polyline, and its squared distance."""
    a, d = curve[:-1], np.diff(curve, axis=0)
    s = np.clip(((p - a) * d).sum(1) / np.maximum((d * d).sum(1), 1e-30), 0, 1)
    q = a + d * s[:, None]
    r = ((q - p) ** 2).sum(1)
    i = int(np.argmin(r))
    return q[i], float(r[i])

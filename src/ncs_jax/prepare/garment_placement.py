"""Where a garment belongs on a body: unit, axes and place, by how it lies on the skin and what passes through it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np

from ncs_jax.io.mesh.axes import TURNS
from ncs_jax.io.records import BodyRecord, GarmentRecord
from ncs_jax.prepare.garment_checks import UNITS
from ncs_jax.prepare.hanging import CENTRED, SHAPED, Trunk, opening_on, trunk_of, upper_opening
from ncs_jax.prepare.placement import Placement, of_no_size
from ncs_jax.prepare.retarget import body_names
from ncs_jax.prepare.straps import lift_to_rest
from ncs_jax.prepare.wearing import Cloth, Skin, beside_middle, cloth_of, large_loops, pierced, skin_of, threaded

__all__ = ["AXES", "TURNED", "place"]

AXES = ("x", "y", "z", "-x", "-y", "-z")  # that may be up in a file
TURNED = {0: 1.0, 90: 0.6, 180: 0.75, 270: 0.6}  # degrees about the vertical, and how much such a place counts
COMMON = (1.0, 0.01, 0.001, 0.0254)  # units that need less of a reason than others
SIZES = 1 / 10, 1.15  # of the body's: what is worn is between
STARTS = 3  # so many starts of every unit and orientation are followed
FINE = 6  # so many of the best places are looked at closely
BRIEFLY = 20  # so many steps of the exact search are taken before places are compared
STEPS = 1 / 20, 1 / 320  # of the body's height: first and last step of the search
SKIN = 1 / 80  # of the body's height: cloth is on the skin within about this distance
ROUGH = 1 / 30, 3.0  # these two, while the places are found roughly
PRESS = 25.0  # a point deep inside the body counts as one so many times as far outside
TINY = 1 / 5  # of the body's height: a garment that is smaller is a sock or a doll's, which its unit must be told for
ON_BODY = 0.05  # least share of a garment that lies on the body
CARRIED, UPWARD = 0.01, 0.6  # m^2 that lie on skin that faces up, to this cosine, where shoulders carry a garment
STAYS = 1.1, 0.5  # the misfit may be so many times that of the best place, and so much of the contact must be there
RIVAL, RESIZED = 0.87, 0.5  # another place is about as good from this share on, one in another unit from this one on
APART = 0.02  # of the height: what is nearer is no other place
FLAT, AWAY = 1.15, 1 / 40  # a place is uncertain where this much of the height away the misfit rises less than so many times
HELD = 0.15, 1.0  # but not upward, where it loses so much of its contact, and so much as far down: something carries it
CLOSE = 0.4  # of the misfit of cloth that is nowhere near: a tube of less misfit fits closely, and its place is certain
STRAPPED = 4, 1 / 25  # openings of a garment with straps or shoulders, at least, and of the height: each is larger than this
RESTING = -0.009, 0.003  # of the height: if its straps are to be lifted by between these, they rest where the file has them,
PRESSED = 0.008  # and up to this where it was moved: the best place is somewhat inside the body
RESTS = "its straps tell the height at which they rest on the body, but it is so loose that its place sideways is uncertain"
SUNK = 0.1  # of its area may be inside the body: it is pushed out
STAYED = "it hangs, and only its waist tells where: it stays at the height that the file has"
ALSO = "it hangs around the trunk where the file has it, but its waist would be held as well {:.0f} cm {}"
KEEP = "; --stay keeps it here"
HANGS = "it hangs, and the girth of its waist tells its height only to some centimetres"
UPSIDE = 0.002, 0.0005  # of the height: what a place upside down, and one turned about the vertical, has less in its favour


@dataclass(frozen=True, eq=False)
class _Way:
    """One unit and orientation (own: the file's; told: its user gave the unit) and a place: points @ turned * scale + shift;
    whether it is `_centred`."""

    scale: float
    up: str
    turn: int
    turned: np.ndarray
    prior: float
    own: bool
    told: bool
    shift: np.ndarray
    cost: float = np.inf
    centred: bool = False

    def points(self, x: np.ndarray) -> np.ndarray:
        return x @ self.turned * self.scale + self.shift


def place(
    file: str | Path,
    garment: GarmentRecord,
    body: BodyRecord,
    *,
    scale: float | None = None,
    up: str | None = None,
    turn: int | None = None,
    move: tuple[float, float, float] | None = None,
) -> Placement:
    """Return the garment in the unit, with the axes and at the place in which it lies on the body.

    Every unit and orientation is tried at places along the body, moved to where the misfit is least, and the best are compared:

        misfit = mean over the garment's area of  25 d^2 / (|d| + L)  inside the body,
                                                  L (1 - (n . n_skin) / (1 + (d / L)^2))  outside

    d is the distance to the skin and L an 80th of the body's height. A larger garment is worth more; the body must pass through
    every opening, and no bone through the cloth. A garment that lies about as well where it is stays there.

    Args:
        file: the garment's, for errors. garment: as read. scale, up, turn: metres a unit of the file, the axis that is up in
            it, and the turn about the vertical, degrees. move: from where the file has it then, m. None: found.

    Raises:
        InputError: in no unit has it the size of something worn.
    """
    raw = replace(garment, vertices=garment.vertices / garment.scale @ TURNS[garment.up].T)
    skin, fine = skin_of(body), cloth_of(raw, 600)
    ways = list(_ways(garment, raw, skin, fine.volume < 0, (scale, up, turn)))
    if not ways:
        raise of_no_size(file, float(np.ptp(raw.vertices, axis=0).max()), skin.height, scale, SIZES)
    stays, hanging = (None, None) if move is not None else _hung(ways, raw, fine, skin, body)
    if stays is not None and not stays.doubt:
        return stays
    here = [replace(w, shift=np.zeros(3) if move is None else np.asarray(move, float)) for w in ways]
    exact = [skin.nearest(w.points(fine.points), fine.normals @ w.turned) for w in here]
    near = [float(_misfit(*e, skin, press=ROUGH[1])) for e in exact]  # even if somewhat inside
    first = sorted(range(len(here)), key=lambda i: (not here[i].own, -_value(replace(here[i], cost=near[i]), fine, skin)))
    here = [replace(here[i], cost=float(_misfit(*exact[i], skin))) for i in first[:FINE]]
    searched = [] if move is not None else _search(ways, cloth_of(raw, 100), fine, skin)
    found = [*(_centred(w, raw, fine, skin) for w in searched), *here]
    seen = [(w, _look(w, raw, fine, skin, body)) for w in found]
    ranked = _ranked(seen, fine, skin)
    best = ranked[0][0]
    if move is None and best.prior < 1:  # the best place unturned too: most garments are alike from front and back
        plain = [w for w in ways if w.scale == best.scale and w.up == best.up[-1] and not w.turn]
        plain = [_moved(replace(w, shift=best.points(fine.middle) - w.points(fine.middle)), fine, skin) for w in plain]
        seen += [(w, _look(w, raw, fine, skin, body)) for w in (_centred(w, raw, fine, skin) for w in plain)]
        ranked = _ranked(seen, fine, skin)
    if move is not None:
        return _given(ranked, fine, skin, (scale is not None, up is not None))
    chosen = _choose(ranked, fine, skin)
    way = next(w for w, look in ranked if look.garment is chosen.garment)
    chosen = _rested(chosen, way, raw, fine, skin, body)
    if chosen.doubt:
        return stays or hanging or chosen
    return (stays or replace(chosen, doubt=HANGS)) if _loose_tube(chosen, way, fine, skin) else chosen


def _ways(garment, raw, skin: Skin, mirrored: bool, given) -> Iterator[_Way]:
    """Yield every unit and orientation in which the garment may be worn."""
    scale, up, turn = given
    size, (least, most) = np.ptp(raw.vertices, axis=0).max() / skin.height, SIZES
    for unit in (scale,) if scale else dict.fromkeys((garment.scale, *UNITS)):
        own = unit == garment.scale
        if not least / 3 <= size * unit <= 1.5 * most or not (own or scale or least <= size * unit <= most):
            continue
        for axis in (up,) if up else AXES:
            for angle in TURNED if turn is None else (turn,):
                turned = TURNS[axis[-1]] @ np.diag([-1, -1, 1] if axis[0] == "-" else [1, 1, 1])
                c, s = round(np.cos(np.radians(angle))), round(np.sin(np.radians(angle)))
                turned = turned @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) @ np.diag([-1 if mirrored else 1, 1, 1])
                usual = (1.0 if own or unit in COMMON else 0.8) * TURNED[angle] * (0.6 if axis[0] == "-" else 1.0)
                yield _Way(unit, axis, angle, turned, usual, own and axis == garment.up and not angle, bool(scale), np.zeros(3))


def _search(ways: list[_Way], rough: Cloth, fine: Cloth, skin: Skin) -> list[_Way]:
    """Return the best places: of every unit from many starts on few points, then briefly on many; the best of all to the end.

    The misfit on few points, or beside the place where it is least, compares nothing by a hair and no units with each other:
    close cloth is half inside until it is moved.
    """

    def best(found: list[_Way]) -> list[_Way]:
        return _different(sorted(found, key=lambda w: -_value(w, fine, skin)), skin)

    near = []
    for unit in dict.fromkeys(w.scale for w in ways):
        first = []
        for way in (w for w in ways if w.scale == unit):
            x, normals = way.points(rough.points), rough.normals @ way.turned
            starts = np.concatenate([np.zeros((1, 3)), skin.places - way.points(rough.middle)])
            costs = _misfit(*skin.roughly(x + starts[:, None], normals), skin, *ROUGH)
            first += [replace(way, shift=starts[k]) for k in np.argsort(costs)[:STARTS]]
        near += [_moved(w, fine, skin, BRIEFLY) for w in best(_stepped(first, rough, fine, skin))[: 2 * FINE]]
    return best([_moved(w, fine, skin) for w in best(near)[:FINE]])


def _stepped(ways: list[_Way], cloth: Cloth, fine: Cloth, skin: Skin) -> list[_Way]:
    """Return ways moved to where their rough misfit is least, by steps along the axes, which are halved where none helps, and
    the misfit of the fine cloth there."""
    x = np.stack([w.points(cloth.points) - w.shift for w in ways])
    normals = np.stack([cloth.normals @ w.turned for w in ways])
    at, step = np.stack([w.shift for w in ways]), np.full(len(ways), STEPS[0] * skin.height)
    around = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    every = np.arange(len(ways))
    for _ in range(20):
        tried = at[:, None] + step[:, None, None] * around
        costs = _misfit(*skin.roughly(x[:, None] + tried[:, :, None], normals[:, None]), skin, *ROUGH)
        best = costs.argmin(axis=1)
        at = tried[every, best]
        step = np.where(best == 0, np.maximum(step / 2, STEPS[1] * skin.height), step)
    moved = [replace(w, shift=at[i]) for i, w in enumerate(ways)]
    return [replace(w, cost=_cost(w.points(fine.points), fine.normals @ w.turned, skin)) for w in moved]


def _different(ways: list[_Way], skin: Skin) -> list[_Way]:
    """Return the ways without those that repeat an earlier one."""
    kept: list[_Way] = []
    for w in ways:
        same = [k for k in kept if k.scale == w.scale and (k.turned == w.turned).all()]
        if all(np.linalg.norm(k.shift - w.shift) > AWAY / 2 * skin.height for k in same):
            kept.append(w)
    return kept


def _moved(way: _Way, cloth: Cloth, skin: Skin, most: int = 100) -> _Way:
    """Return a way moved to where its misfit is least, by so many steps at most."""
    from scipy.optimize import minimize

    x, normals = way.points(cloth.points) - way.shift, cloth.normals @ way.turned
    simplex = way.shift + skin.height / 60 * np.vstack([np.zeros(3), np.eye(3)])
    best = minimize(
        lambda shift: _cost(x + shift, normals, skin), way.shift, method="Nelder-Mead",
        options={"xatol": 1e-3, "fatol": 1e-6, "maxiter": most, "initial_simplex": simplex},
    )  # fmt: skip
    return replace(way, shift=best.x, cost=float(best.fun))


def _centred(way: _Way, raw: GarmentRecord, cloth: Cloth, skin: Skin) -> _Way:
    """Return a way with the garment's middle in the body's, if both are alike left and right and it lies as well there."""
    aside = beside_middle(way.points(raw.vertices.astype(np.float64)), raw.faces, skin)
    if aside is None or abs(aside) > AWAY * skin.height:
        return way
    shift = way.shift - [aside, 0, 0]
    cost = _cost(way.points(cloth.points) - [aside, 0, 0], cloth.normals @ way.turned, skin)
    return replace(way, shift=shift, cost=cost, centred=True) if cost < FLAT * way.cost else way


def _cost(x: np.ndarray, normals: np.ndarray, skin: Skin) -> float:
    """Return the misfit of points and normals (N, 3), m."""
    return float(_misfit(*skin.nearest(x, normals), skin))


def _misfit(away, side, facing, skin: Skin, near: float = SKIN, press: float = PRESS) -> np.ndarray:
    """Return the misfit (...,) of points whose distance, side and cosine to the skin (..., N) are given, m."""
    near = near * skin.height
    contact = np.maximum(facing, 0) / (1 + (away / near) ** 2)
    depth = np.where(side < 0, away, 0)
    return np.mean(np.where(side < 0, press * depth**2 / (depth + near), near * (1 - contact)), axis=-1)


def _value(way: _Way, cloth: Cloth, skin: Skin) -> float:
    """Return the share of contact, less what is inside, times the garment's size, m, and how usual unit and axes are.

    The share alone would choose a doll's dress around an arm, the area of contact a tent that leans on the body.
    """
    value = (1 - way.cost / (SKIN * skin.height)) * np.sqrt(cloth.area) * way.scale
    return value * way.prior if value > 0 else value / way.prior


def _look(way: _Way, raw: GarmentRecord, cloth: Cloth, skin: Skin, body: BodyRecord) -> Placement:
    """Return the garment at a place, how it lies there, and what by itself speaks against it."""
    away, side, facing = skin.nearest(way.points(cloth.points), cloth.normals @ way.turned)
    lying = float(np.mean((facing > 0.5) & (away < 2 * SKIN * skin.height)))
    inside = float(np.mean(side < 0))
    x = way.points(raw.vertices)
    names = body_names(body) or tuple(f"joint {j}" for j in range(len(body.parents)))
    bones = tuple(names[j] for j in pierced(x, raw.faces, skin))
    share = threaded([x[loop] for loop in cloth.loops], skin)
    garment = replace(raw, vertices=x.astype(raw.vertices.dtype), scale=way.scale, up=way.up)
    mirrored, doubt = cloth.volume < 0, _doubt(lying, bones, share)
    return Placement(garment, way.scale, way.up, way.turn, mirrored, way.shift, lying, inside, bones, share, doubt)


def _given(ranked: list[tuple[_Way, Placement]], cloth: Cloth, skin: Skin, told: tuple[bool, bool]) -> Placement:
    """Return a place that was given, in the file's own unit and axes where no others fit; told: its user gave unit and axis.

    Against it speaks only what rules it out: nothing of it is around the body or lies on it, or it is in doubt and its unit and
    axes are guessed. All else is a warning.
    """
    own = [r for r in ranked if r[0].own]
    way, look = own[0] if ranked[0][1].doubt and own else ranked[0]
    if not look.doubt:
        return replace(look, given=True)
    around = look.threaded > 0 and bool(large_loops([look.garment.vertices[loop] for loop in cloth.loops], skin))
    if not around and look.lying < ON_BODY and _carried(way, cloth, skin) < CARRIED:
        doubt = f"the body passes through none of its openings, and {100 * look.lying:.0f} % of it lie on the skin"
        return replace(look, doubt=doubt, given=True)
    if not (way.own or all(told)):
        return replace(look, doubt=f"its unit and axes are not stated, and as they are guessed {look.doubt}", given=True)
    return replace(look, doubt="", warning=look.doubt, given=True)


def _carried(way: _Way, cloth: Cloth, skin: Skin) -> float:
    """Return the area, m^2, that lies on skin that faces up, as a cape does or a sheet, whose outside nothing tells."""
    there, normals = way.points(cloth.points), cloth.normals @ way.turned
    away, side, facing = skin.nearest(there, normals)
    upward = skin.normals[skin.tree.query(there)[1], 1] > UPWARD
    on = (np.abs(facing) > 0.5) & (away < 2 * SKIN * skin.height) & (side > -SKIN * skin.height) & upward
    return float(on.mean()) * cloth.area * way.scale**2


def _ranked(seen: list[tuple[_Way, Placement]], cloth: Cloth, skin: Skin) -> list[tuple[_Way, Placement]]:
    """Return places, the best first: what speaks against none, then what touches the body, then by value."""
    return sorted(seen, key=lambda r: (bool(r[1].doubt), r[1].lying < ON_BODY, -_value(r[0], cloth, skin)))


def _rested(chosen: Placement, way: _Way, raw: GarmentRecord, cloth: Cloth, skin: Skin, body: BodyRecord) -> Placement:
    """Return a loose garment with straps or shoulders at the height at which they rest on the body, in doubt if it was moved by
    that: cloth that hangs free hides how little of it carries the rest."""
    large = sum(np.linalg.norm(np.ptp(raw.vertices[k], axis=0)) * way.scale > STRAPPED[1] * skin.height for k in cloth.loops)
    if chosen.pierced or chosen.threaded <= 0.99 or way.cost < CLOSE * SKIN * skin.height or large < STRAPPED[0]:
        return chosen
    lift = lift_to_rest(way.points(raw.vertices), raw.faces, body)
    most = PRESSED if way.shift.any() else RESTING[1]
    if lift is None or RESTING[0] * skin.height < lift < most * skin.height:
        return chosen
    found = _look(replace(way, shift=way.shift + [0, lift, 0]), raw, cloth, skin, body)
    return replace(found, doubt=found.doubt or chosen.doubt or RESTS, warning="")


def _choose(ranked: list[tuple[_Way, Placement]], cloth: Cloth, skin: Skin) -> Placement:
    """Return the best place, or the garment's own where that is about as good, with what speaks against it."""
    way, best = ranked[0]
    large = [r for r in ranked if _size(r[0], cloth) > TINY * skin.height] or ranked
    top, refused = max(large, key=lambda r: (r[1].lying >= ON_BODY, _value(r[0], cloth, skin)))
    placed = not way.shift.any() and not way.turn
    if best.doubt or (not placed and _value(way, cloth, skin) < RIVAL * _value(top, cloth, skin)):
        return refused  # what lies far better there is worn there, though it cannot be: a shirt is no sock
    if not placed and way.cost > SKIN * skin.height:
        return replace(best, doubt=f"{100 * best.inside:.0f} % of it are inside the body, too deep for what lies on it")
    least = _value(way, cloth, skin)
    least = least * STAYS[1] if least > 0 else least / STAYS[1]
    for own, look in sorted(ranked, key=lambda r: (not r[0].own, -r[0].prior)):
        small = np.linalg.norm(way.shift) < AWAY * skin.height and (own.turned == way.turned).all()
        alike = own.scale != way.scale or small or own.cost <= STAYS[0] * way.cost
        if (
            not (own.shift.any() or look.doubt)
            and (own.own or own.turn in (0, way.turn))
            and alike
            and _value(own, cloth, skin) >= least
        ):
            return look
    kept = [(own, look) for own, look in ranked if not own.shift.any() and not own.turn and look.worn]
    rival, (loose, warning) = _rivals(ranked, cloth, skin), _uncertain(way, cloth, skin)
    if not rival and loose and kept and not kept[0][1].doubt and _value(kept[0][0], cloth, skin) >= least:
        return kept[0][1]
    if rival or loose:
        return replace(kept[0][1] if kept else best, doubt=rival or loose)
    size = _size(way, cloth)
    tiny = f"it is {100 * size:.0f} cm large there, and in another unit it might be larger" if size < TINY * skin.height else ""
    return replace(best, doubt="" if way.told else tiny, warning=warning)


def _size(way: _Way, cloth: Cloth) -> float:
    """Return the longest side of the garment's box, m."""
    return float(np.ptp(way.points(cloth.points), axis=0).max())


def _doubt(lying: float, bones: tuple[str, ...], share: float) -> str:
    """Return what speaks against a place by itself."""
    if lying < ON_BODY:
        return f"{100 * lying:.0f} % of it lie on the skin, at least {100 * ON_BODY:.0f} % are expected"
    if bones:
        return f"bones pass through its cloth ({', '.join(bones[:4])}), so it is for another pose or another body"
    if share <= 0.99:
        return f"the body passes through {100 * share:.0f} % of its openings by length, not through all"
    return ""


def _rivals(ranked: list[tuple[_Way, Placement]], cloth: Cloth, skin: Skin) -> str:
    """Name a second place that is about as good as the first, and elsewhere."""
    from scipy.spatial import cKDTree

    way = ranked[0][0]
    tree, least = cKDTree(way.points(cloth.points)), _value(way, cloth, skin)
    for other, look in ranked[1:]:
        share = RIVAL if other.scale == way.scale else RESIZED
        apart = tree.query(other.points(cloth.points))[0].mean()
        good = _value(other, cloth, skin) > (least * share if least > 0 else least / share)
        good |= other.scale == way.scale and other.cost < RIVAL * way.cost  # only how usual its turn is speaks against it
        if good and not look.doubt and apart > APART * skin.height:
            return f"it lies about as well elsewhere, with {look.options}"
    return ""


def _uncertain(way: _Way, cloth: Cloth, skin: Skin) -> tuple[str, str]:
    """Name the direction in which the garment may as well be moved; else what is uncertain though it does not speak against it.

    Cloth that hangs free has the same misfit everywhere and hides how much the rest loses. A garment that shoulders or hips
    carry is held from below: it may be lifted without much ado, but it falls back to where it lies on them.
    """
    x, normals = way.points(cloth.points), cloth.normals @ way.turned
    step, worst, warning = AWAY * skin.height, SKIN * skin.height, ""

    def lost(shift: np.ndarray) -> tuple[float, float]:
        cost = _cost(x + step * shift, normals, skin)
        return cost / way.cost, (cost - way.cost) / max(worst - way.cost, 1e-9 * worst)

    for k, words in ((1, "up or down"), (0, "sideways"), (2, "back or forth")):
        for sign in () if k == 0 and way.centred else (1, -1):
            ratio, less = lost(sign * np.eye(3)[k])
            if ratio >= FLAT:
                continue
            if (k, sign) != (1, 1) or less < HELD[0] or lost(-np.eye(3)[1])[1] < HELD[1]:
                return f"it is so loose that it lies as well {100 * step:.0f} cm farther {words}", ""
            warning = f"it is loose, and only what carries it tells its height: {100 * step:.0f} cm higher it still has "
            warning += f"{100 * (1 - less):.0f} % of the contact"
    return "", warning


def _loose_tube(chosen: Placement, way: _Way, cloth: Cloth, skin: Skin) -> bool:
    """Tell whether a garment only hangs there: it lies closest some centimetres lower than where it was made."""
    loops = [chosen.garment.vertices[loop] for loop in cloth.loops]
    return way.cost > CLOSE * SKIN * skin.height and upper_opening(loops) is not None


def _hung(ways: list[_Way], raw: GarmentRecord, cloth: Cloth, skin: Skin, body: BodyRecord) -> tuple[Placement | None, ...]:
    """Return where a skirt or a strapless dress hangs, by its upper opening: where the file has it, and else.

    The first is None where it does not hang there in one unit and upright axis alone: by chance none does. Where the waist
    would be held as well higher or lower, it is in doubt; in the file's own unit and axes, that is only said. The second is
    None where the opening does not tell the unit. It is in doubt, because girth and shape of a waist that is wider than the
    trunk fit several centimetres higher and lower.
    """
    here, other, trunk = [], [], trunk_of(body)
    for way in ways:
        opening = upper_opening([way.points(raw.vertices[loop]) for loop in cloth.loops])
        if opening is not None:
            farther, moved = _waists(way, opening, trunk, skin)
            here += [] if farther is None or way.turn else [(way, farther)]
            other += [moved] if moved else []

    def first(found: list[_Way]) -> list[Placement]:
        looks = (_look(w, raw, cloth, skin, body) for w in found)
        return list(islice((k for k in looks if not k.pierced and k.threaded > 0.99 and k.inside < SUNK), 1))

    kept = first([here[0][0]]) if len(here) == 1 else []
    at, farther = here[0] if kept else (None, 0.0)
    also = ALSO.format(abs(100 * farther), "higher" if farther > 0 else "lower") if farther else ""
    doubt, warning = (also + KEEP, STAYED) if also and at is not None and not at.own else ("", also or STAYED)
    other.sort(key=lambda w: w.cost)
    told = [k for unit in {w.scale for w in other} for k in first([w for w in other if w.scale == unit][:FINE])]
    return (
        replace(kept[0], doubt=doubt, warning=warning) if kept else None,
        replace(told[0], doubt=HANGS) if len(told) == 1 else None,
    )


def _waists(way: _Way, opening: np.ndarray, trunk: Trunk, skin: Skin) -> tuple[float | None, _Way | None]:
    """Return how an opening fits around the trunk: where the file has it, how much farther up it would be held as well (m, 0:
    nowhere; None: it does not fit); and the place where it fits best, if any."""
    tall, height = skin.height, float(opening[:, 1].mean())
    fit = opening_on(trunk, opening)
    cost = fit.cost(tall)
    if not np.isfinite(cost).any():
        return None, None
    near = int(np.abs(fit.heights - height).argmin())
    close = abs(fit.heights[near] - height) < CENTRED * tall and np.linalg.norm(fit.shift[near]) < CENTRED * tall
    best = int(np.where(trunk.carries(), cost, cost + SHAPED * tall).argmin())
    side, against = fit.shift[best], UPSIDE[0] * (way.up[0] == "-") + UPSIDE[1] * (way.turn > 0)
    shift = np.array([side[0], fit.heights[best] - height, side[1]])
    stays = close and cost[near] < cost[best] + SHAPED / 2 * tall
    return fit.farther(near, tall) if stays else None, replace(way, shift=shift, cost=float(cost[best] + against * tall))

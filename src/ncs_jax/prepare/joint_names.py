"""What the joints of a skeleton are: limbs by their names, see `joint_words`, by what hangs on what, and by their shape."""

from __future__ import annotations

from collections.abc import Collection, Container, Mapping, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher

import numpy as np

from ncs_jax.io.character.hierarchy import path_to_root
from ncs_jax.prepare.joint_shape import limbs_by_shape
from ncs_jax.prepare.joint_words import EITHER, MIDDLE, ROLES, Name, read_names

__all__ = ["BONES", "Limbs", "anatomy", "listed", "pair", "propose", "side_and_rest", "undriven"]

BONES = {"arm": "upper arm", "forearm": "forearm", "thigh": "thigh", "shin": "shin", "foot": "foot"}
ENDS = (("shin", "foot"), ("forearm", "hand"))  # what follows the last long bone of a limb, whatever it is called
TOES = 3  # as many toes or more beside each other are single toes, and none of them is the ball of the foot


@dataclass(frozen=True)
class Limbs:
    """The joints of a skeleton by what they are.

    roles: the joint of each role, such as "hips", "head", "left forearm"; a joint without a role is listed by its plain name.
    spine: joints from above or beside the hips to the one that carries the arms. neck: joints from there to below the head.
    pelvis: the joint below the hips and beside the spine that carries both legs; None where the hips carry them.
    shaped: roles that the names do not tell, but the skeleton's shape at rest.
    """

    roles: dict[str, int]
    spine: tuple[int, ...]
    neck: tuple[int, ...]
    shaped: tuple[str, ...] = ()
    pelvis: int | None = None


class _Tree:
    """What hangs on what: the path of each joint to the root, itself first, and how many joints hang on it."""

    def __init__(self, parents: Sequence[int]):
        self.above = [path_to_root(parents, j) for j in range(len(parents))]
        self.load = np.zeros(len(parents), int)
        for path in self.above:
            self.load[path] += 1

    def meet(self, *joints: int) -> int | None:
        """Return the joint farthest from the root that carries all of these."""
        return next((j for j in self.above[joints[0]] if self.carries(j, *joints)), None)

    def carries(self, low: int, *joints: int) -> bool:
        """Tell whether all of these hang on a joint, or are it."""
        return all(low in self.above[j] for j in joints)

    def between(self, low: int, high: int | None) -> tuple[int, ...]:
        """Return the joints above `low` up to and with `high`; none where `high` does not hang on `low`."""
        if high is None or low not in self.above[high]:
            return ()
        return tuple(reversed(self.above[high][: self.above[high].index(low)]))


def anatomy(names: Sequence[str], parents: Sequence[int], joints: np.ndarray | None = None) -> Limbs:
    """Find out what the joints are: limbs by their names; spine and neck, whatever they are called, by what hangs on them.

    Limbs that the names do not tell are told by the places of the joints at rest, see `limbs_by_shape`, if they are given and
    contradict no name.

    Case, separators, numbering and what a rig puts before or behind all names do not matter. What a shoulder, hip, hand, foot
    or leg means depends on what is above and below: SMPL's shoulder bends the upper arm, Mixamo's carries it. The hips are the
    lowest joint of such a name, or of any, that carries both legs and the trunk.

    Args:
        names: of the joints. parents: their parents, before them, -1 at the root. joints: (J, 3) at rest, in any unit.
    """
    read, tree = read_names(names), _Tree(parents)
    named = _limb_roles(read, tree)
    shaped = {} if joints is None else _missing(named, read, parents, joints)
    roles = named | shaped
    for side in ("left", "right"):
        for above, below in ENDS:
            roles |= _lone_end(f"{side} {below}", roles.get(f"{side} {above}"), roles, read, parents)

    def meet(*words: str) -> int | None:
        """Return the joint that carries a role of both sides."""
        for word in words:
            if f"left {word}" in roles and f"right {word}" in roles:
                return tree.meet(roles[f"left {word}"], roles[f"right {word}"])
        return None

    legs, chest, head = meet("hip joint", "thigh"), meet("clavicle", "arm"), roles.get("head")
    head = _last_of_neck(read, tree, chest, set(roles.values())) if head is None else head
    roles |= {} if head is None else {"head": head}
    if (top := head if chest is None else chest) is not None:  # Biped's arms hang on the neck
        chest = next((j for j in tree.above[top] if not read[j].rest.startswith(("neck", "head"))), chest)
    hips = _hips(read, tree, legs, chest)
    spine = tree.between(hips, chest)
    neck = tree.between(chest if chest is not None else hips, head)[:-1]
    told, trunk = set(roles.values()), {hips, *spine, *neck}
    for j, name in enumerate(read):
        if j not in told:
            roles.setdefault(f"{name.side} {name.finger or name.rest}".strip(), j)
    roles = {word: j for word, j in roles.items() if j not in trunk} | {"hips": hips}
    beside = legs is not None and legs != hips and legs not in spine and tree.carries(hips, legs)
    return Limbs(roles, spine, neck, tuple(word for word in roles if word in shaped), legs if beside else None)


def _lone_end(role: str, above: int | None, roles: dict[str, int], read: list[Name], parents: Sequence[int]) -> dict[str, int]:
    """Return the joint of a role that the names lack, if one alone, called anything, hangs on the joint above."""
    on = [j for j, n in enumerate(read) if parents[j] == above and n.side in ("", role.split()[0]) and not (n.kind or n.finger)]
    return {role: on[0]} if above is not None and role not in roles and len(on) == 1 and on[0] not in roles.values() else {}


def _missing(named: dict[str, int], read: list[Name], parents: Sequence[int], joints: np.ndarray) -> dict[str, int]:
    """Return the roles of limbs that names lack and the shape has; none where no long bone is lacking, or a name says else."""
    if all(f"{side} {role}" in named for side in ("left", "right") for role in ("arm", "forearm", "thigh", "shin")):
        return {}
    shape = limbs_by_shape(parents, joints, {j: name.side for j, name in enumerate(read) if name.side})
    told = {j: word for word, j in named.items()}
    if any(told.get(j, word) != word or named.get(word, j) != j for word, j in shape.items()):
        return {}
    return {word: j for word, j in shape.items() if word not in named}


def _limb_roles(read: list[Name], tree: _Tree) -> dict[str, int]:
    """Return the joint of each limb's role and the head: the one whose name is nearest to the word, then of most joints."""
    found: dict[str, tuple[int, int, int]] = {}
    for j, name in enumerate(read):
        role = _role(j, read, tree)
        if not role or (role in MIDDLE) != (name.side == ""):
            continue
        key = (name.order, -int(tree.load[j]), j)
        found[f"{name.side} {role}".strip()] = min(key, found.get(f"{name.side} {role}".strip(), key))
    named = {role: j for role, (_, _, j) in found.items() if role != "hips"}
    return _key_points(read, tree, named) | named


def _key_points(read: list[Name], tree: _Tree, named: dict[str, int]) -> dict[str, int]:
    """Return what pose estimators call a head, the nose with eyes or ears on it, and a toe, the big one with few beside it."""
    nose = [j for j, n in enumerate(read) if n.rest == "nose" and not n.side]
    on = {read[j].rest for j in range(len(read)) if nose and nose[0] in tree.above[j][1:]}
    found = {"head": nose[0]} if len(nose) == 1 and any(word.endswith(("eye", "ear")) for word in on) else {}
    for side in ("left", "right"):
        toes = [j for j, n in enumerate(read) if n.side == side and n.rest.endswith("toe")]
        big, foot = [j for j in toes if read[j].rest == "bigtoe"], named.get(f"{side} foot")
        if len(big) == 1 and len(toes) < TOES and foot in tree.above[big[0]]:
            found[f"{side} toe"] = big[0]
    return found


def _role(j: int, read: list[Name], tree: _Tree) -> str:
    """Return a joint's role; "" where its name has none. A word of EITHER is told by its side's joints above and below it."""
    name = read[j]
    beside = {i: n.word for i, n in enumerate(read) if i != j and n.side == name.side and n.word}
    roles = {i: "" if word in EITHER else ROLES[word] for i, word in beside.items()}

    def near(what: str, where: list[int] | None = None) -> bool:
        """Tell whether a joint of this side has this word or role: anywhere, or among some."""
        return any(what in (beside[i], roles[i]) and (where is None or i in where) for i in beside)

    above, below = tree.above[j][1:], [i for i in beside if j in tree.above[i]]
    match name.word if name.side else ROLES.get(name.word, ""):
        case "shoulder":
            arms = any(near(word) for word in ("arm", "shldr"))
            return "arm" if not arms else "clavicle" if near("arm", below) else ""
        case "hip":
            return "thigh" if not near("thigh") else "hip joint" if near("thigh", below) else ""
        case "hand":
            return "palm" if near("hand", [i for i in above if read[i].word == "wrist"]) else "hand"
        case "palm":
            return "" if near("hand") else "hand"
        case "foot":
            return "toe" if near("foot", [i for i in above if read[i].word != "foot"]) else "foot"
        case "leg" | "arm" as word:
            upper, lower = ("thigh", "shin") if word == "leg" else ("arm", "forearm")
            uppers = [i for i in beside if roles[i] == upper]
            if uppers:
                return lower if not near(lower) and any(i in above for i in uppers) else ""
            again = any(beside[i] == word and read[i].number[:1] < name.number[:1] for i in above if i in beside)
            return lower if again and not near(lower) else upper
        case "toe" | "toes":
            first = [i for i in tree.above[j] if i == j or roles.get(i) == "toe"][-1]
            toes = [i for i in (j, *beside) if (i == j or roles[i] == "toe") and tree.above[i][1:2] == tree.above[first][1:2]]
            return "" if len(toes) >= TOES else "toe"
        case word:
            return ROLES.get(word, "") if word not in EITHER else ""


def _last_of_neck(read: list[Name], tree: _Tree, chest: int | None, limbs: set[int]) -> int | None:
    """Return the head where none is called so: the last of the necks, or of what goes on above the chest before it branches."""
    plain = {j for j, n in enumerate(read) if not n.side and not n.kind} - limbs
    if rises := [j for j in plain if read[j].rest.startswith("neck")]:
        return max(rises, key=lambda j: len(tree.above[j]))
    last, above = None, [j for j in plain if chest in tree.above[j][1:2]]
    while above and (last is None or len(above) == 1):
        last = max(above, key=lambda j: tree.load[j])
        above = [j for j in plain if last in tree.above[j][1:2]]
    return last


def _hips(read: list[Name], tree: _Tree, legs: int | None, chest: int | None) -> int:
    """Return the lowest joint that is called hips and carries legs and trunk, else the lowest that does, called anything."""
    carried = [j for j in (legs, chest) if j is not None]
    called = [j for j, n in enumerate(read) if not n.side and ROLES.get(n.word) == "hips"]
    called.sort(key=lambda j: (read[j].order, -len(tree.above[j])))
    lowest = tree.meet(*carried) if carried and legs is not None else None
    return next((j for j in called if tree.carries(j, *carried)), lowest if lowest is not None else next(iter(called), 0))


def pair(source: Limbs, target: Limbs) -> dict[int, int]:
    """Return the source's joint that drives each joint of the target: the one of equal role; spine and neck are spread evenly.

    The last joints of both spines are paired, because the arms hang on them. Where one spine is a single joint, the source's
    last joint drives the target's lowest. A pelvis beside the spine, as of Daz and MMD, drives the target's, or its hips.
    """
    pairs = {j: source.roles[word] for word, j in target.roles.items() if word in source.roles}
    for here, there in ((source.spine, target.spine), (source.neck, target.neck)):
        count = min(len(here), len(there))
        for i in range(count):
            pairs[there[_spread(i, count, len(there), 0)]] = here[_spread(i, count, len(here), len(here) - 1)]
    if source.pelvis is not None:
        pairs[target.roles["hips"] if target.pelvis is None else target.pelvis] = source.pelvis
    return dict(sorted(pairs.items()))


def _spread(i: int, count: int, length: int, lone: int) -> int:
    """Return the place of pair i of `count` in a chain of `length` joints; that of a lone pair is given."""
    return lone if count == 1 else round(i * (length - 1) / (count - 1))


def side_and_rest(names: Sequence[str]) -> list[tuple[str, str]]:
    """Return for each name of a skeleton the side ("left", "right" or "") and the rest, in small letters."""
    return [(name.side, name.rest) for name in read_names(names)]


def undriven(body: Limbs, pairs: Container[int]) -> dict[str, int]:
    """Return what of the body nothing drives, such as "left upper arm", "spine" or "head", and the joint that would move it.

    Hands, collars and toes are no matter: without a partner they go on as the bone above does.
    """
    found = {f"{side} {bone}": body.roles.get(f"{side} {role}") for side in ("left", "right") for role, bone in BONES.items()}
    if not any(j in pairs for j in body.spine):
        found["spine"] = next(iter(body.spine), None)
    if not any(j in pairs for j in body.neck):
        found["head"] = body.roles.get("head")
    return {limb: j for limb, j in found.items() if j is not None and j not in pairs}


def propose(limb: str, name: str, names: Sequence[str], parents: Sequence[int], used: Collection[int]) -> str:
    """Return the joint of a motion that most likely drives a limb, "" where all are used: of its side, of a name like it.

    Args:
        limb: of `undriven`. name: of the body's joint. names, parents: of the motion. used: its joints that drive something.
    """
    read, tree = read_names(names), _Tree(parents)
    side = limb.split()[0] if limb.split()[0] in ("left", "right") else ""
    free = [j for j, n in enumerate(read) if j not in used and n.side in ("", side) and not (n.kind or n.finger)]
    like = {j: SequenceMatcher(None, name.lower(), names[j].lower()).ratio() for j in free}
    return names[max(free, key=lambda j: (read[j].side == side, like[j], tree.load[j]))] if free else ""


def listed(names: Sequence[str], shown: Mapping[str, str]) -> str:
    """Return some of a skeleton's joints in a line, as they are shown; fingers, face and helpers are only counted."""
    small = {n for n, one in zip(names, read_names(names), strict=True) if one.finger or one.kind}
    large = [text for name, text in shown.items() if name not in small]
    count = len(shown) - len(large)
    rest = [f"{count} finger, face or helper joint{'s' if count > 1 else ''}"] if count else []
    return " and ".join([", ".join(large), *rest] if large else rest)

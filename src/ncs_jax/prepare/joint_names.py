"""Joints told by their names: the conventions of CMU, MakeHuman, Poser, SMPL, Mixamo, Blender, Unreal and Biped."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from ncs_jax.io.character.hierarchy import path_to_root

__all__ = ["Limbs", "anatomy", "pair", "side_and_rest"]

PREFIX = re.compile(
    r"^(mixamorig\d*[_\-. :]*|(j[_ ]?bip([_ ]c(?=[_ ]))?|bip\d+|def|org|valvebiped|cc[_ ]base|[mf][_ ]avg)[_\-. :]+)", re.I
)
PART = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
HIPS = ("pelvis", "hips", "hip", "spinebase", "root")  # the first that is there
WORDS = {
    "clavicle": ("collar", "collarbone", "clavicle", "innershoulder", "shouldergirdle"),
    "arm": ("arm", "upperarm", "uparm", "shldr"),
    "forearm": ("forearm", "lowerarm", "lowarm", "elbow"),
    "hand": ("wrist",),
    "hip joint": ("hipjoint", "buttock"),
    "thigh": ("upleg", "upperleg", "thigh"),
    "shin": ("shin", "knee", "calf", "lowerleg", "lowleg"),
    "foot": ("ankle",),
    "toe": ("toe", "toes", "toebase", "ball", "toe0"),
}
ROLES = {word: role for role, words in WORDS.items() for word in words}
# The role of these words depends on what else the side has. Each: the role alone, the rival role, the role beside the rival.
EITHER = {
    "shoulder": ("arm", "arm", "clavicle"),
    "hip": ("thigh", "thigh", "hip joint"),
    "leg": ("shin", "shin", "thigh"),
    "hand": ("hand", "hand", "palm"),
    "foot": ("foot", "foot", "toe"),
}
FINGER = re.compile(r"(?:hand)?(thumb|index|middle|mid|ring|pinky|little|finger)(\d*)")
SAME_FINGER = {"mid": "middle", "little": "pinky", "finger": "index"}  # MakeHuman's one finger is a BVH's index finger


@dataclass(frozen=True)
class Limbs:
    """The joints of a skeleton by what they are.

    roles: the joint of each role, such as "hips", "head", "left forearm"; a joint without a role is listed by its plain name.
    spine: joints from above or beside the hips to the one that carries the arms. neck: joints from there to below the head.
    """

    roles: dict[str, int]
    spine: tuple[int, ...]
    neck: tuple[int, ...]


def anatomy(names: Sequence[str], parents: Sequence[int]) -> Limbs:
    """Find out what the joints are: limbs by their names; spine and neck, whatever they are called, by what hangs on them.

    Case, separators and a rig's prefixes do not matter. What a shoulder, hip, hand or foot means depends on what else its side
    has: SMPL's shoulder bends the upper arm, Mixamo's carries it.

    Args:
        names: of the joints. parents: their parents, before them, -1 at the root.
    """
    plain = [side_and_rest(name) for name in names]
    roles: dict[str, int] = {}
    for j, (side, word) in enumerate(plain):
        beside = {w for s, w in plain if s == side} if side else set()
        roles.setdefault(f"{side} {_role(word, beside)}".strip(), j)
    above = [path_to_root(parents, j) for j in range(len(names))]

    def meet(*words: str) -> int | None:
        """Return the joint farthest from the root that carries a role of both sides."""
        for word in words:
            if f"left {word}" in roles and f"right {word}" in roles:
                both = [j for j in above[roles[f"left {word}"]] if j in above[roles[f"right {word}"]]]
                return max(both, key=lambda j: len(above[j]), default=None)
        return None

    legs, chest, head = meet("hip joint", "thigh"), meet("clavicle", "arm"), roles.get("head")
    hips = next((roles[w] for w in HIPS if w in roles), legs if legs is not None else 0)
    if head is None:  # the last of the necks, or of what else goes on above the chest in the middle
        rises = [j for word, j in roles.items() if word.startswith("neck")]
        if not rises and chest is not None:
            rises = [j for j in range(len(names)) if chest in above[j][1:] and not any(plain[i][0] for i in above[j])]
        head = max(rises, key=lambda j: len(above[j]), default=None)
        roles |= {} if head is None else {"head": head}
    if chest is None and head is not None:
        carried = [j for j in above[head] if not plain[j][1].startswith(("neck", "head"))]
        chest = carried[0] if carried else None
    common = next((j for j in above[hips] if chest is not None and j in above[chest]), hips)  # hips and spine may be siblings
    spine = _between(common, chest, above)
    neck = _between(chest if chest is not None else hips, head, above)[:-1]
    trunk = {hips, *spine, *neck}
    roles = {word: j for word, j in roles.items() if j not in trunk} | {"hips": hips}
    return Limbs(roles, spine, neck)


def pair(source: Limbs, target: Limbs) -> dict[int, int]:
    """Return the source's joint that drives each joint of the target: the one of equal role; spine and neck are spread evenly.

    The last joints of both spines are paired, because the arms hang on them. Where one spine is a single joint, the source's
    last joint drives the target's lowest.
    """
    pairs = {j: source.roles[word] for word, j in target.roles.items() if word in source.roles}
    for here, there in ((source.spine, target.spine), (source.neck, target.neck)):
        count = min(len(here), len(there))
        for i in range(count):
            pairs[there[_spread(i, count, len(there), 0)]] = here[_spread(i, count, len(here), len(here) - 1)]
    return dict(sorted(pairs.items()))


def _spread(i: int, count: int, length: int, lone: int) -> int:
    """Return the place of pair i of `count` in a chain of `length` joints; that of a lone pair is given."""
    return lone if count == 1 else round(i * (length - 1) / (count - 1))


def side_and_rest(name: str) -> tuple[str, str]:
    """Return the side ("left", "right" or "") and the rest of a name, in small letters and without separators."""
    parts = [p.lower() for p in PART.findall(PREFIX.sub("", re.split(r"[:|]", name)[-1]))]
    parts = [str(int(p)) if p.isdigit() else p for p in parts]
    for side in ("left", "right"):
        for mark in (side, side[0]):
            if mark in parts:
                parts.remove(mark)
                return side, "".join(parts)
    word = "".join(parts)
    for side in ("left", "right"):
        if word.startswith(side) or word.endswith(side):
            return side, word.removeprefix(side).removesuffix(side)
        if word[:1] == side[0] and (word[1:] in ROLES or word[1:] in EITHER or FINGER.fullmatch(word[1:])):
            return side, word[1:]
    return "", word


def _role(word: str, beside: set[str]) -> str:
    """Return the role of a plain word, given the plain words of its side; the word itself where it has none."""
    if found := FINGER.fullmatch(word):
        finger = "thumb" if word.endswith("finger0") else SAME_FINGER.get(found[1], found[1])
        return f"{finger} {found[2] if found[2] not in ('', '0') else 1}"
    word = word.removesuffix("1") if word not in ROLES and word.removesuffix("1") in {*ROLES, *EITHER} else word
    if word not in EITHER or not beside:
        return ROLES.get(word, word)
    alone, rival, then = EITHER[word]
    others = {ROLES.get(w.removesuffix("1")) for w in beside if w != word}
    if word == "leg":  # a thigh only where something else is the shin
        return then if "shin" in others and "thigh" not in others else alone
    return then if rival in others else alone


def _between(low: int, high: int | None, above: list[list[int]]) -> tuple[int, ...]:
    """Return the joints above `low` up to and with `high`; none where `high` does not hang on `low`."""
    if high is None or low not in above[high]:
        return ()
    return tuple(reversed(above[high][: above[high].index(low)]))

"""Names of joints taken apart: what all names share is dropped, a side is found, and the rest is looked up in a vocabulary."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["Name", "read_names"]

PART = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W\d_A-Za-z]+")
BRACKETS = re.compile(r"[\[(].*?[\])]")  # "NPC L Thigh [LThg]"
NUMBERED = re.compile(r"[_.\- ]\d+$"), re.compile(r"^\d+[_.\- ]+")  # "Hips_01", "Hips.001", "01_Hips"
SIDES = {"left": "left", "l": "left", "lt": "left", "lft": "left",
         "right": "right", "r": "right", "rt": "right", "rgt": "right"}  # fmt: skip


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


# What a word of a limb is called. The role of the words of EITHER depends on what is above and below, see `joint_names`.
WORDS = {
    "clavicle": "collar collarbone clavicle clavical clav innershoulder shouldergirdle scapula shoulderblade sternoclavicular",
    "arm": "upperarm uparm armupper armup shldr humerus uarm",
    "forearm": "forearm forarm lowerarm lowarm loarm armlower armlow elbow radius farm",
    "hand": "wrist radiocarpal",
    "hip joint": "hipjoint buttock",
    "thigh": "upleg upperleg legupper legup thigh femur uleg",
    "shin": "shin knee calf lowerleg lowleg loleg leglower leglow tibia shank",
    "foot": "ankle talocrural",
    "toe": "toe toes toebase ball",
    "head": "head skull skullbase",
    "hips": "pelvis hips hip spinebase hipcenter centerhip midhip lowertorso",
}
ROLES = {word: role for role, words in WORDS.items() for word in words.split()}
EITHER = _words("shoulder hip hand palm foot leg arm")
MIDDLE = _words("head hips")  # roles without a side
TOES = _words("bigtoe smalltoe")  # of pose estimators
FINGER = re.compile(r"(?:in)?(?:hand)?(thumb|index|middle|mid|ring|pinky|little|fingers?)(?:finger)?")
BIPED = ("thumb", "index", "middle", "ring", "pinky")
SEGMENTS = {"proximal": "1", "intermediate": "2", "medial": "2", "distal": "3"}

# Words that say nothing, of one letter too: the middle, or a kind of bone.
FILLERS = _words("jnt jt joint bind bn bone skin sk def org deform drv fk stretch bend bended anim rig c m x j b f")
# Words of joints that carry no limb: between two others, beside them, at their ends, or of things that are worn.
HELPERS = _words(
    """twist twst tw roll ik pole end tip nub helper hlp share target tgt ctrl control mch tweak corrective corr offset dummy
    attach socket weapon prop holster gun breast bust pectoral pec skirt cloth cape part metacarpal carpal muscle scale goal
    parent pivot aim driver volume fix adj sec jiggle physics site effector locator null proxy guide metatarsal metatarsals
    heel extra cancel wing tail bag strap belt big small"""
)
HELPER = re.compile(
    r"twist|helper|corrective|sharebone|fingerbase|metacarp|metatars|effector|(?<=.)roll$|^(big|small|index|mid|ring|pinky)toe"
)
FACE = _words(
    """face facial eye eyes eyeball eyelid eyelids lid brow brows eyebrow jaw mouth lip lips tongue teeth tooth nose nostril
    cheek chin ear ears forehead temple hair hat glasses beard squint blink"""
)

# Names in Japanese (MMD) and the Chinese ones that mean nothing else there.
TRANSLATED = {
    "left": "左", "right": "右", "ankle": "足首", "wrist": "手首 手腕", "toe": "つま先 足先 脚趾 足趾", "elbow": "ひじ 肘",
    "knee": "ひざ 膝", "forearm": "前腕 前臂 小臂", "upperarm": "上腕 上臂 大臂", "thigh": "大腿 太もも", "shin": "小腿 すね",
    "clavicle": "鎖骨 锁骨", "arm": "腕", "shoulder": "肩", "leg": "足 脚", "hand": "手", "head": "頭 头", "neck": "首 脖子 颈",
    "spine": "上半身", "lowerbody": "下半身", "center": "センター", "groove": "グルーブ", "waist": "腰", "chest": "胸",
    "cancel": "キャンセル", "pelvis": "骨盆 骨盤", "thumb": "親指", "index": "人指 人差指", "middle": "中指", "ring": "薬指",
    "pinky": "小指", "finger": "指", "twist": "捩", "eye": "目", "end": "先", "parent": "親", "hair": "髪", "tongue": "舌",
    "teeth": "歯",
}  # fmt: skip
ENGLISH = {one: word for word, ones in TRANSLATED.items() for one in ones.split()}
FOREIGN = re.compile("|".join(sorted(ENGLISH, key=len, reverse=True)))


@dataclass(frozen=True)
class Name:
    """A joint's name as it was understood.

    side: "left", "right" or "". rest: all else, in small letters and without separators; it tells joints of one side apart.
    word: of the vocabulary, such as "upperarm", or "". order: how far the name is from that word alone; the least is meant.
    number: what counts it, without leading zeros, or "". finger: such as "index 1", or "". kind: "helper" (also of clothes),
    "face" or "".
    """

    side: str
    rest: str
    word: str = ""
    order: int = 0
    number: str = ""
    finger: str = ""
    kind: str = ""


def read_names(names: Sequence[str]) -> list[Name]:
    """Take the names of one skeleton apart.

    Dropped are namespaces and brackets, a number behind nearly every name ("Hips_01"), the words in front of or behind more
    than half of the names that the vocabulary does not have ("Hero_", "_jnt"), and letters that all names share.
    """
    plain = [_plain(name) for name in names]
    for number in NUMBERED:
        if sum(bool(number.search(name)) for name in plain) >= 0.8 * len(plain):
            plain = [number.sub("", name) for name in plain]
    read = [_read(parts) for parts in _without_shared([_parts(name) for name in plain])]
    small = [name.lower() for name in plain]
    front, back = _shared_letters(small), _shared_letters([name[::-1] for name in small])
    for cut in (slice(front, None), slice(None, -back or None)):  # without a separator
        other = [_read(parts) for parts in _without_shared([_parts(name[cut]) for name in plain])]
        read = max(read, other, key=lambda some: sum((1 + bool(n.side)) * (n.word != "" and n.order < 10) for n in some))
    return read


def _shared_letters(names: list[str]) -> int:
    """Count the letters that begin all names."""
    low, high = min(names, default=""), max(names, default="")
    return next((k for k, (a, b) in enumerate(zip(low, high, strict=False)) if a != b), min(len(low), len(high)))


def _plain(name: str) -> str:
    """Return a name without brackets and namespaces, of plain letters, in English where it is Japanese or Chinese."""
    name = BRACKETS.sub("", unicodedata.normalize("NFKC", name))
    name = next((part for part in reversed(re.split(r"[:|/]", name)) if part and not part.isdigit()), name)  # "lHand:2"
    return FOREIGN.sub(lambda found: f" {ENGLISH[found[0]]} ", name).strip()


def _parts(name: str) -> list[str]:
    """Return the words and numbers of a name in small letters."""
    return [part.lower() for part in PART.findall(name)]


def _means(part: str) -> bool:
    """Tell whether a part of a name says what a joint is."""
    known = part in ROLES or part in EITHER or part in HELPERS or part in FACE or FINGER.fullmatch(part)
    return bool(known) or part in SIDES or part in {"upper", "lower", "up", "low", "fore", "spine", "neck", "chest", "abdomen"}


def _without_shared(rows: list[list[str]]) -> list[list[str]]:
    """Return the parts without those that stand before or behind all names, or more than half, and mean nothing."""
    for end, rest in ((0, slice(1, None)), (-1, slice(None, -1))):
        while True:
            long = [row for row in rows if len(row) > 1]
            part, count = Counter(row[end] for row in long).most_common(1)[0] if long else ("", 0)
            every = 1 < count == len(long) and (part not in SIDES or _has_other_side(part, long))
            some = count > len(rows) / 2 and not _means(part) and not (part.isdigit() and end == -1)
            if not (every or some):
                break
            rows = [row[rest] if len(row) > 1 and row[end] == part else row for row in rows]
    return rows


def _has_other_side(part: str, rows: list[list[str]]) -> bool:
    """Tell whether some names have the other side than this mark, which is then no side where all names share it."""
    return any(SIDES.get(p, SIDES[part]) != SIDES[part] for row in rows for p in row)


def _read(parts: list[str]) -> Name:
    """Return what the parts of one name say."""
    side, parts = _side(parts)
    rest = "".join(str(int(p)) if p.isdigit() else p for p in parts)
    letters = [p for p in parts if not p.isdigit()]
    numbers = [p for p in parts if p.isdigit()]
    joined = "".join(letters)
    if not HELPERS.isdisjoint(letters) or HELPER.search(joined):
        return Name(side, rest, kind="helper")
    if not FACE.isdisjoint(letters):
        return Name(side, rest, kind="face")
    kept = [p for p in letters if p not in FILLERS] or letters
    if finger := _finger(kept, numbers, side):
        return Name(side, rest, finger=finger)
    long = [p for p in kept if len(p) > 1]
    for order, some in [(0, kept), *((10 * k + len(kept) - len(long), long[k:]) for k in range(len(long)))]:
        if word := _known("".join(some)):
            return Name(
                side, rest, word, order + bool(numbers) + ("org" in letters), numbers[-1].lstrip("0") if numbers else ""
            )
    return Name(side, rest)


def _known(word: str) -> str:
    """Return a word of the vocabulary, without what stands behind it without a separator; "" where there is none."""
    for one in (word, re.sub(r"(bend|stretch|jnt|joint|bone|bind)$", "", word), re.sub("^(arm|leg)", "", word)):
        if one in ROLES or one in EITHER:
            return one
    return ""


def _finger(letters: list[str], numbers: list[str], side: str) -> str:
    """Return the finger and its segment, counted from 1, such as "index 1"; "" for no finger."""
    found = FINGER.fullmatch("".join(p for p in letters if p not in SEGMENTS))
    if not found or not side:
        return ""
    segment = next((SEGMENTS[p] for p in letters if p in SEGMENTS), numbers[-1] if numbers else "1")
    if found[1] == "finger" and len(numbers) == 1:  # as Biped counts: Finger0 is the thumb, Finger21 the middle one's second
        return f"{BIPED[min(int(numbers[0][0]), 4)]} {int(numbers[0][1:] or 0) + 1}"
    return f"{ {'mid': 'middle', 'little': 'pinky'}.get(found[1], found[1]) } {segment.lstrip('0') or '0'}"


def _side(parts: list[str]) -> tuple[str, list[str]]:
    """Return the side and the other parts. A letter needs a word beside it, or to be last: Xsens' L5 is a vertebra."""

    def cut(at: int, rest: str) -> list[str]:
        return [*parts[:at], *([rest] if rest else []), *parts[at + 1 :]]

    for long in (True, False):
        for at, part in enumerate(parts):
            if (
                part in SIDES
                and (len(part) > 2) == long
                and (any(p.isalpha() for p in cut(at, "")) or at == len(parts) - 1 > 0)
            ):
                return SIDES[part], cut(at, "")
    for mark in ("left", "right", "l", "r"):  # "lfemur" and "arml"; a letter needs a word beside it that is known
        for at, part in enumerate(parts):
            for rest in (part.removeprefix(mark), part.removesuffix(mark)):
                known = len(mark) > 1 or _is_limb(rest) or _is_limb(rest + "".join(parts[at + 1 :]))
                if rest and rest != part and known:
                    return SIDES[mark], cut(at, rest)
    return "", parts


def _is_limb(word: str) -> bool:
    """Tell whether a word is one of a limb, or begins with one and goes on as twists do."""
    helped = HELPER.sub("", word) or word
    return (
        word in TOES
        or (ROLES.get(_known(helped), "head") not in MIDDLE or _known(helped) in EITHER)
        or bool(FINGER.match(helped))
    )

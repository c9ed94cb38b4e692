"""The name that a user may have meant: by the words that two names share, by what words mean, and by their letters.

Place in the pipeline: used by `errors`; imports nothing of the library.
"""

import re
from collections.abc import Iterable
from difflib import SequenceMatcher

# By difflib, "legnth" is like "length" by 0.83, "rk5" like "rk4" by 0.67, but so is "other" like "note".
LIKENESS, LIKENESS_OF_SAME_LETTER = 0.7, 0.65
SHARED = 0.5  # of the words of two names, from which on one may be meant by the other
LIKE_WORDS = 0.8  # likeness of two words from which on one is a slip of the pen for the other

# Words that mean about the same: users say one for another.
SYNONYMS = (
    ("max", "maximum", "maximal", "largest", "highest", "peak"),
    ("rms", "mean", "average", "effective"),
    ("force", "forces", "load", "loads", "reaction", "reactions"),
    ("moment", "moments", "torque", "torques"),
    ("delta", "tilt", "tilted", "rotation", "rot"),
    ("d", "shift", "offset", "translation", "trans"),
    ("deflection", "bending", "sag"),
    ("range", "stroke", "swing", "travel"),
    ("mass", "weight"),
    ("length", "len"),
    ("coaxiality", "concentricity"),
    ("perpendicularity", "squareness", "orthogonality"),
    ("damping", "damper"),
    ("stiffness", "rate"),
    ("youngs", "elastic", "e"),
)
_MEANT = {word: group[0] for group in SYNONYMS for word in group}


def nearest(name: object, known: Iterable[object]) -> str | None:
    """Return the entry of `known` (strings) that `name` may stand for, or None: one with most of its words, or words of
    their meaning, or one with nearly its letters."""
    by_lower_case = {str(entry).lower(): str(entry) for entry in known}
    wanted = str(name).lower()
    words = _words(wanted)
    letters = SequenceMatcher(b=wanted)
    best, found = 0.0, None
    for entry in by_lower_case:
        shared = _shared(words, _words(entry))
        limit = LIKENESS_OF_SAME_LETTER if entry[:1] == wanted[:1] else LIKENESS
        likeness = _likeness(letters, entry, 0.0 if shared >= SHARED else limit)
        if (shared >= SHARED or likeness >= limit) and shared + likeness > best:
            best, found = shared + likeness, by_lower_case[entry]
    return found


def _likeness(letters: SequenceMatcher, entry: str, least: float) -> float:
    """Likeness of two names by their letters, 0 where it is below `least`, which is seen at a glance for most."""
    letters.set_seq1(entry)
    if letters.real_quick_ratio() < least or letters.quick_ratio() < least:
        return 0.0
    return letters.ratio()


def _words(name: str) -> list[str]:
    return [word for word in re.split(r"[^a-z0-9]+", name) if word]


def _shared(words: list[str], others: list[str]) -> float:
    """Share of the words of two names that both have, by letters or meaning: 1 for the same words."""
    left = list(others)
    for word in words:
        match = next((other for other in left if _alike(word, other)), None)
        if match is not None:
            left.remove(match)
    both = len(others) - len(left)
    return both / max(len(words) + len(others) - both, 1)


def _alike(word: str, other: str) -> bool:
    if word == other or _MEANT.get(word, word) == _MEANT.get(other, other):
        return True
    # Short words such as axes differ by a letter because they are others.
    return min(len(word), len(other)) > 3 and SequenceMatcher(None, word, other).ratio() >= LIKE_WORDS

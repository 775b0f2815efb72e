"""The text of one g2o file, parsed tag by tag: ids and numbers of every line, and what is wrong.

A sound file takes a short way: blocks of some megabytes, in which all lines of a tag are parsed by
one call. Only when that call fails are the lines looked at one by one, to name the wrong ones.
"""

import re
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pgo_models.errors import FileFormatError
from pgo_models.files import LARGEST, LONGEST, Problem, check_length, finite_number
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.g2o_dialects import NO_OFFSET
from pgo_models.graphs.g2o_tags import (
    ALIASES,
    COMPLETE_TAGS,
    OFFSET_TAGS,
    REFUSED_TAGS,
    SHORT_TAGS,
    SKIPPED_TAGS,
    TAGS,
    WITH_ANGLES,
    Tag,
)
from pgo_models.graphs.origin import remainder_of
from pgo_models.graphs.pose_graph import WORLD_ID, IntArray
from pgo_models.graphs.tables import COMMENT_SIGNS

_SHOWN = 40  # characters of a wrong word that a message shows
_COMMENT = re.compile(r"(#|//|%).*")
# Fortran writes 1.5e-3 as 1.5D-03.
_FORTRAN_EXPONENT = re.compile(r"(?<=[0-9.])[dD](?=[+-]?[0-9])")
_INFINITE = re.compile(r"[+-]?(inf|infinity|nan)", re.IGNORECASE)
# A robust kernel, with or without its width, behind the numbers of an edge.
_KERNEL = re.compile(
    r"\s((ROBUST_)?KERNEL|(RobustKernel)?(Huber|PseudoHuber|Cauchy|DCS|Fair|GemanMcClure|Saturated"
    r"|Tukey|Welsch))\b.*"
)


class ParsedLines(NamedTuple):
    """Lines of one tag: their numbers in the file, and what stands on them."""

    lines: IntArray  # (n,)
    ids: IntArray  # (n, num_ids + num_other_ids)
    numbers: Array  # (n, num_numbers)

    def some(self, chosen: BoolArray) -> "ParsedLines":
        """Lines that are chosen, (n,)."""
        return ParsedLines(self.lines[chosen], self.ids[chosen], self.numbers[chosen])


class Source:
    """What the lines of a file hold, parsed tag by tag.

    Where that fails, the lines are looked at one by one. `problems` has those that are wrong.
    """

    def __init__(self, path: Path, skip_unknown: bool) -> None:
        self.path = path
        self.skip_unknown = skip_unknown
        self.parsed: dict[str, list[ParsedLines]] = {tag: [] for tag in TAGS}
        self.written_tags: set[str] = set()  # all tags of parsed lines, as the file has them
        self.fixed: list[tuple[int, int]] = []  # a pose and its line
        self.problems: list[Problem] = []
        self.unknown: dict[str, tuple[int, int]] = {}  # tag: how many lines, and the first
        self.skipped: dict[str, int] = {}  # tags that are skipped by their nature: how many lines
        self.num_kernels = 0
        # Lines of priors to what their decimals have beyond the doubles that they are read as.
        self.remainders: dict[int, list[float]] = {}
        # Poses of sensors: dimension and id, as it is written, to lines and words behind the id.
        self.offsets: dict[tuple[int, str], list[tuple[int, list[str]]]] = {}

    def take(self, first_line: int, lines: list[str]) -> None:
        """Sort lines by their tags, and parse the lines of each tag by one call.

        The first line has the number `first_line` in the file.
        """
        numbers = np.arange(first_line, first_line + len(lines))
        if "" in lines:
            is_blank = np.array([not line for line in lines])
            numbers = numbers[~is_blank]
            lines = [line for line in lines if line]
        places: dict[str, list[int]] = {}
        for place, line in enumerate(lines):
            if words := line.split(None, 1):
                places.setdefault(words[0], []).append(place)
        for written_tag, places_of_tag in places.items():
            numbers_of_tag = numbers[places_of_tag]
            lines_of_tag = [lines[place] for place in places_of_tag]
            tag = ALIASES.get(written_tag, written_tag)
            if tag in TAGS:
                self._take_measurements(tag, written_tag, numbers_of_tag, lines_of_tag)
            elif not written_tag.startswith(COMMENT_SIGNS):
                plain_lines = [_without_comment(line) for line in lines_of_tag]
                self._take_others(tag, numbers_of_tag.tolist(), plain_lines)

    def _take_measurements(
        self, tag: str, written_tag: str, numbers: IntArray, lines: list[str]
    ) -> None:
        """Take VERTEX or EDGE lines, whose tag may be written as an alias."""
        kind = TAGS[tag]
        if self._parse(tag, written_tag, numbers, _with_all_ids(kind, lines)):
            return
        lines = _with_all_ids(kind, [self._plain(line) for line in lines])
        if self._parse(tag, written_tag, numbers, lines):
            return
        if tag == "EDGE2" and all(map(_has_hypotheses, lines)):
            raise self._error(
                int(numbers[0]),
                "EDGE2 lines hold several hypotheses of a measurement (MH-iSAM2), and a pose graph "
                "has one measurement an edge; write the right one as EDGE_SE2",
            )
        for line_tag, places in _places_by_length(tag, written_tag, lines).items():
            some_lines = [lines[place] for place in places]
            self._take_sound_lines(line_tag, written_tag, numbers[places], some_lines)

    def _plain(self, line: str) -> str:
        """A line without comment and robust kernel, its exponents written with e."""
        line, num_kernels = _KERNEL.subn("", _without_comment(line))
        self.num_kernels += num_kernels
        return _FORTRAN_EXPONENT.sub("e", line)

    def _take_sound_lines(
        self, tag: str, written_tag: str, numbers: IntArray, lines: list[str]
    ) -> None:
        """Take the lines that are sound, and note the problems of the others."""
        if self._parse(tag, written_tag, numbers, lines):
            return
        sound = []
        for place, line in enumerate(lines):
            number = int(numbers[place])
            try:
                check_length(self.path, number, line)
                self._check_line(tag, number, line)
            except FileFormatError as error:
                self.problems.append((number, error.problem))
            else:
                sound.append(place)
        sound_lines = [lines[place] for place in sound]
        if sound and not self._parse(tag, written_tag, numbers[sound], sound_lines):
            problem = (
                f"the {tag} lines cannot be read; write numbers like 1.5e-3, separated by blanks"
            )
            self.problems.append((int(numbers[sound[0]]), problem))

    def _take_others(self, tag: str, numbers: list[int], lines: list[str]) -> None:
        """Take lines of a tag that is no measurement's."""
        if tag == "FIX":
            self._take_fixed(numbers, lines)
        elif tag in SKIPPED_TAGS:
            self.skipped[tag] = self.skipped.get(tag, 0) + len(lines)
        elif tag in OFFSET_TAGS.values():
            d = 2 if tag == OFFSET_TAGS[2] else 3
            for number, line in zip(numbers, lines, strict=True):
                _, *words = line.split()
                offset_id = "".join(words[:1])
                self.offsets.setdefault((d, offset_id), []).append((number, words[1:]))
        elif tag.startswith("PARAMS_"):
            return
        elif tag in REFUSED_TAGS and not self.skip_unknown:
            problem = f"{tag} measures {REFUSED_TAGS[tag]}, which no edge of a pose graph has"
            way_out = "remove such lines, or skip them with --skip-unknown"
            raise self._error(numbers[0], f"{problem}; {way_out}")
        else:
            shown_tag = tag[:_SHOWN]
            count, first = self.unknown.get(shown_tag, (0, numbers[0]))
            self.unknown[shown_tag] = (count + len(numbers), first)

    def _take_fixed(self, numbers: list[int], lines: list[str]) -> None:
        """Collect the ids on FIX lines, and the problems of words that are no id."""
        for number, line in zip(numbers, lines, strict=True):
            for word in line.split()[1:]:
                try:
                    self.fixed.append((self._id(number, word), number))
                except FileFormatError as error:
                    self.problems.append((number, error.problem))

    def _parse(self, tag: str, written_tag: str, numbers: IntArray, lines: list[str]) -> bool:
        """Parse lines of one tag by one call, keep what they hold, and return if they are sound.

        They are sound unless a line has another tag, an id that is no integer, a number that is not
        finite, or another number of words.
        """
        kind = TAGS[tag]
        if max(map(len, lines)) > LONGEST:
            return False
        shared_end = _shared_end(lines, kind.num_numbers - 1)
        num_shared = len(shared_end.split())
        num_own = kind.num_numbers - num_shared
        ids_field = ("ids", "i8", (kind.num_ids + kind.num_other_ids,))
        numbers_field = ("numbers", "f8", (num_own,))
        row_type = np.dtype([("tag", f"S{len(written_tag) + 1}"), ids_field, numbers_field])
        own_ends = lines
        if shared_end:
            own_ends = [line.rstrip().removesuffix(shared_end) for line in lines]
        shared = np.zeros((1, 0))
        try:
            # NumPy warns of an id like 1.0, which is none.
            with warnings.catch_warnings(action="error", category=DeprecationWarning):
                rows = np.loadtxt(own_ends, comments=None, ndmin=1, dtype=row_type)
            if shared_end:
                shared = np.loadtxt([shared_end], comments=None, ndmin=2)
        except (ValueError, DeprecationWarning):
            return False
        ids = rows["ids"]
        repeated = shared.repeat(len(rows), axis=0)
        values = np.concatenate([rows["numbers"], repeated], axis=1)
        has_tag = rows["tag"] == written_tag.encode()
        if len(ids) != len(numbers) or not has_tag.all():
            return False
        is_finite = np.abs(values) <= LARGEST
        if (ids == WORLD_ID).any() or not is_finite.all():
            return False
        parsed = ParsedLines(numbers, ids.copy(), values)
        self.parsed[tag].append(parsed)
        self.written_tags.add(written_tag)
        if kind.is_edge and kind.num_ids == 1:
            self._note_remainders(kind, parsed, lines)
        return True

    def _note_remainders(self, kind: Tag, parsed: ParsedLines, lines: list[str]) -> None:
        """Note what the positions of priors have beyond their doubles, as far ones are shifted."""
        first = 1 + kind.num_ids + kind.num_other_ids
        count = 2 if kind.is_level else kind.d
        values = parsed.numbers[:, :count].tolist()
        for number, line, row in zip(parsed.lines.tolist(), lines, values, strict=True):
            words = line.split(None, first + count)[first : first + count]
            remainders = map(remainder_of, words, row)
            self.remainders[number] = [*remainders, *[0.0] * (kind.d - count)]

    def _check_line(self, tag: str, number: int, line: str) -> None:
        """Raise a FileFormatError when a word of a line is wrong, or there are not enough."""
        kind = TAGS[tag]
        words, other_ids = _words(kind, line)
        words_of_ids = words[: kind.num_ids]
        words_of_numbers = words[kind.num_ids :]
        for word in [*words_of_ids, *other_ids]:
            self._id(number, word)
        for place, word in enumerate(words_of_numbers):
            if kind.is_edge and place >= kind.num_measured and _INFINITE.fullmatch(word):
                problem = (
                    f"{word} is not finite, like the information of a covariance of zero; give the "
                    "variances of the sensor, or remove the line"
                )
                raise self._error(number, problem)
            finite_number(self.path, number, word)
        expected = kind.num_ids + kind.num_numbers
        if len(words) == expected:
            return
        ids = "1 id" if kind.num_ids == 1 else f"{kind.num_ids} ids"
        cause = "the line is cut off" if len(words) < expected else "the line is too long"
        problem = (
            f"{tag} needs {ids} and {kind.num_numbers} numbers, {expected} in all, "
            f"found {len(words)}; {cause}: complete or remove it"
        )
        raise self._error(number, problem)

    def _id(self, line: int, word: str) -> int:
        """Id of a pose, which has 64 bits."""
        # int() also takes 1_000 and the digits of other scripts; number files do not.
        is_plain = word.isascii() and "_" not in word
        try:
            value = int(word if is_plain else "")
        except ValueError:
            problem = f"id {word[:_SHOWN]!r} is no integer; number the poses"
            raise self._error(line, problem) from None
        if not -(2**63) <= value < WORLD_ID:
            raise self._error(
                line,
                f"id {word[:_SHOWN]} does not fit 64 bits, less one that stands for the world; "
                "renumber the poses",
            )
        return value

    def _error(self, line: int, problem: str) -> FileFormatError:
        return FileFormatError(self.path, line, problem)


def _without_comment(line: str) -> str:
    return _COMMENT.sub("", line)


def _places_by_length(tag: str, written_tag: str, lines: list[str]) -> dict[str, list[int]]:
    """Places of lines by the variant of their tag that has as many words, or the tag itself."""
    variants: dict[int, str] = {}
    for names, key in ((SHORT_TAGS, tag), (COMPLETE_TAGS, tag), (WITH_ANGLES, written_tag)):
        if key in names:
            variant = TAGS[names[key]]
            variants[1 + variant.num_ids + variant.num_numbers] = names[key]
    places: dict[str, list[int]] = {}
    for place, line in enumerate(lines):
        name = variants.get(len(line.split()), tag)
        places.setdefault(name, []).append(place)
    return places


def _words(kind: Tag, line: str) -> tuple[list[str], list[str]]:
    """Ids and numbers on a line; and ids of offsets or switches, which may stand between them."""
    words = line.split()[1:]
    num_words = kind.num_ids + kind.num_other_ids + kind.num_numbers
    if not kind.num_other_ids or len(words) != num_words:
        return words, []
    behind = kind.num_ids + kind.num_other_ids
    return words[: kind.num_ids] + words[behind:], words[kind.num_ids : behind]


def _with_all_ids(kind: Tag, lines: list[str]) -> list[str]:
    """Lines of a tag, with ids that stand for none where one of an offset or switch is missing."""
    if not kind.num_other_ids:
        return lines
    return [_with_other_ids(kind, line) for line in lines]


def _with_other_ids(kind: Tag, line: str) -> str:
    tag, *_ = line.split(None, 1)
    words, other_ids = _words(kind, line)
    if len(words) == kind.num_ids + kind.num_numbers:
        none = [str(NO_OFFSET)] * kind.num_other_ids
        words[kind.num_ids : kind.num_ids] = other_ids or none
    return " ".join([tag, *words])


def _has_hypotheses(line: str) -> bool:
    """Whether an EDGE2 line holds several measurements, of which one is right.

    Behind the tag are the pose, the choices of it, the other pose, its choices, the number of
    hypotheses, and x y theta for each (Hsiao & Kaess, MH-iSAM2, 2019).
    """
    words = line.split()[1:]
    num_numbers = len(words) - 5
    return num_numbers > 0 and num_numbers % 3 == 0 and words[4] == str(num_numbers // 3)


def _shared_end(lines: list[str], most: int) -> str:
    """Words that all lines end with but for blanks, as information matrices are often the same.

    It is empty where these words are more than `most`.
    """
    # The first and the last line are compared word by word, from the end on.
    first = lines[0].rstrip().split(" ")[::-1]
    last = lines[-1].rstrip().split(" ")[::-1]
    pairs = enumerate(zip(first, last, strict=False))
    differences = (place for place, (a, b) in pairs if a != b)
    count = next(differences, 0)
    shared_words = first[:count][::-1]
    shared_end = " " + " ".join(shared_words)
    num_shared = len(shared_end.split())
    if not 0 < num_shared <= most:
        return ""
    is_shared = all(line.rstrip().endswith(shared_end) for line in lines)
    return shared_end if is_shared else ""

"""From the text of a requirement to its tree. Every name, unit and dimension is checked here, before any run is looked at.

    always (luffing.mode == fail-safe implies eventually[0 s, 200 ms] abs(luffing.valve_command) < 1 %)
    always[2 s, 60 s] (abs(luffing.rod_position - 600 mm) < 5 mm until[0 s, 1 s] luffing.end_stop)

Weakest first: iff, implies (to the right), or, and, until and since, then `not` and the temporal operators of one operand. Comparisons
bind tighter, arithmetic tighter still. `->`, `<->`, `!`, `&`, `|` are other ways to write the words.
"""

import difflib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

from hilrunner.base.errors import UsageError
from hilrunner.requirements import dimension as units
from hilrunner.requirements.tree import (
    Arithmetic,
    Condition,
    Constant,
    Expression,
    Formula,
    Interval,
    Logic,
    Number,
    Predicate,
    Signal,
    Temporal,
)

DEPTH_MAX = 50
LENGTH_MAX = 20_000
_UNARY = {"always": "always", "eventually": "eventually", "historically": "historically", "once": "once"}
_BINARY = ("until", "since")
_COMPARISONS = ("<=", ">=", "==", "!=", "<", ">")
_WORDS = {"->": "implies", "<->": "iff", "!": "not", "&": "and", "|": "or", "&&": "and", "||": "or"}
_KEYWORDS = {*_UNARY, *_BINARY, "not", "and", "or", "implies", "iff", "true", "false"}
_FUNCTIONS = {"abs": 1, "min": 2, "max": 2, "rate": 1}
_UNIT_NAMES = "|".join(re.escape(name) for name in sorted(units.UNITS, key=len, reverse=True) if name != "1")
_TOKEN = re.compile(
    rf"""(?P<space>\s+)
    |(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)(?:\s*(?P<unit>{_UNIT_NAMES})(?![\w/%]))?
    |(?P<name>[A-Za-z_]\w*(?:\.[A-Za-z_0-9]\w*)*(?:-[A-Za-z]\w*)*)
    |(?P<mark><->|->|<=|>=|==|!=|&&|\|\||[-+*/<>()\[\],:!&|])""",
    re.VERBOSE,
)


@dataclass(frozen=True)
class SignalKind:
    """What is known of a signal before a run is read: its dimension, or its words if it holds one of several."""

    dimension: units.Dimension
    words: tuple[str, ...] = ()  # mode names, by value
    truth: bool = False  # it is 0 or 1


@dataclass(frozen=True)
class _Token:
    kind: str  # number, name, mark, end
    text: str
    at: int
    value: float = 0.0
    unit: str | None = None


def parse_formula(text: str, signals: Mapping[str, SignalKind], place: str) -> Formula:
    """The tree of a formula.

    Args:
        text: the formula. signals: every name it may use. place: named in errors.

    Raises:
        UsageError: not a formula, an unknown signal or unit, or a comparison of different quantities; names the position.
    """
    if len(text) > LENGTH_MAX:
        raise UsageError(place, f"{len(text)} characters", f"at most {LENGTH_MAX}", "split the requirement")
    parser = _Parser(text, signals, place)
    formula = parser.formula()
    parser.expect("end", "")
    return formula


class _Parser:
    """Recursive descent over the tokens; each method takes what it names."""

    def __init__(self, text: str, signals: Mapping[str, SignalKind], place: str) -> None:
        self.text, self.signals, self.place = text, signals, place
        self.depth = 0
        self.tokens = self._tokens()
        self.next = 0

    def _tokens(self) -> list[_Token]:
        found, at = [], 0
        while at < len(self.text):
            match = _TOKEN.match(self.text, at)
            if match is None:
                self.refuse(at, f"{self.text[at]!r} has no meaning here")
            if match["number"] is not None:
                found.append(_Token("number", match[0], at, float(match["number"]), match["unit"]))
            elif match["name"] is not None:
                found.append(_Token("name", match["name"], at))
            elif match["mark"] is not None:
                word = _WORDS.get(match["mark"])
                found.append(_Token("name", word, at) if word else _Token("mark", match["mark"], at))
            at = match.end()
        return [*found, _Token("end", "the end", len(self.text))]

    def refuse(self, at: int, problem: str, limit: str = "", remedy: str = "") -> None:
        shown = self.text[max(at - 20, 0) : at] + " >>> " + self.text[at : at + 30]
        raise UsageError(
            f"{self.place}, character {at + 1}",
            f"{problem} (at {shown.strip()!r})",
            limit,
            remedy or "mend the formula",
        )

    @property
    def token(self) -> _Token:
        return self.tokens[self.next]

    def take(self) -> _Token:
        self.next += 1
        return self.tokens[self.next - 1]

    def takes(self, *texts: str) -> bool:
        """Take the token if it is one of these."""
        if self.token.kind != "end" and self.token.text in texts and self.token.kind != "number":
            self.next += 1
            return True
        return False

    def expect(self, kind: str, text: str) -> _Token:
        token = self.token
        if token.kind != kind or (text and token.text != text):
            self.refuse(token.at, f"expected {text or kind} and found {token.text!r}")
        return self.take()

    def formula(self) -> Formula:
        return self._truth(self._iff(), self.token.at)

    def _truth(self, node: object, at: int) -> Formula:
        """The node as something that is true or false: a signal that holds 0 or 1 is one."""
        if isinstance(node, Signal) and self.signals[node.name].truth:
            return Condition(node.name, None, False, node.name)
        if isinstance(node, (Number, Signal, Arithmetic)):
            self.refuse(at, "a value where something true or false is needed", remedy="compare it, as in: x < 5 mm")
        return node

    def _iff(self) -> object:
        node = self._implies()
        while self.token.text == "iff" and self.token.kind == "name":
            at = self.take().at
            node = Logic("iff", (self._truth(node, at), self._truth(self._implies(), at)))
        return node

    def _implies(self) -> object:
        node = self._or()
        if self.token.text == "implies":
            at = self.take().at
            self._deeper(at)
            node = Logic("implies", (self._truth(node, at), self._truth(self._implies(), at)))
            self.depth -= 1
        return node

    def _many(self, word: str, below) -> object:
        node = below()
        if self.token.text != word:
            return node
        parts = []
        while self.token.text == word:
            at = self.take().at
            parts.append(self._truth(node, at) if not parts else node)
            node = self._truth(below(), at)
        return Logic(word, (*parts, node))

    def _or(self) -> object:
        return self._many("or", self._and)

    def _and(self) -> object:
        return self._many("and", self._until)

    def _until(self) -> object:
        node = self._unary()
        while self.token.kind == "name" and self.token.text in _BINARY:
            word = self.take()
            interval = self._interval()
            node = Temporal(word.text, (self._truth(node, word.at), self._truth(self._unary(), word.at)), interval)
        return node

    def _deeper(self, at: int) -> None:
        self.depth += 1
        if self.depth > DEPTH_MAX:
            self.refuse(at, "nested too deeply", f"{DEPTH_MAX} levels", "split the requirement")

    def _unary(self) -> object:
        token = self.token
        if token.kind == "name" and (token.text in _UNARY or token.text == "not"):
            self._deeper(token.at)
            self.take()
            interval = self._interval() if token.text in _UNARY else Interval()
            inner = self._truth(self._unary(), token.at)
            self.depth -= 1
            return Logic("not", (inner,)) if token.text == "not" else Temporal(token.text, (inner,), interval)
        return self._comparison()

    def _interval(self) -> Interval:
        if not self.takes("["):
            return Interval()
        begin = self._seconds()
        if not self.takes(",", ":"):
            self.refuse(self.token.at, "an interval needs a comma", remedy="write it as [0 s, 200 ms]")
        end = math.inf if self.takes("inf") else self._seconds()
        at = self.expect("mark", "]").at
        if end < begin:
            self.refuse(at, f"the interval ends at {end:g} s, before it begins at {begin:g} s")
        return Interval(begin, end)

    def _seconds(self) -> float:
        token = self.expect("number", "")
        if token.unit is None and token.value == 0.0:
            return 0.0
        unit = units.UNITS.get(token.unit or "")
        if unit is None or unit.dimension != units.UNITS["s"].dimension:
            self.refuse(token.at, "a bound of an interval is a time", "s, ms, us, min", "write it as [0 s, 200 ms]")
        return token.value * unit.factor

    def _comparison(self) -> object:
        at = self.token.at
        left = self._sum()
        if not (self.token.kind == "mark" and self.token.text in _COMPARISONS):
            return left
        operator = self.take()
        if not isinstance(left, (Number, Signal, Arithmetic)):
            self.refuse(operator.at, "only values can be compared")
        word = self._word_after(left, operator, at)
        if word is not None:
            return word
        right = self._sum()
        if not isinstance(right, (Number, Signal, Arithmetic)):
            self.refuse(operator.at, "only values can be compared")
        self._same(left, right, operator, "compared")
        text = self.text[at : self.token.at].strip()
        return Predicate(operator.text, left, right, left.dimension, text)

    def _word_after(self, left: object, operator: _Token, at: int) -> Condition | None:
        """`mode == fail-safe`: the right side is one of the signal's own words."""
        if not isinstance(left, Signal) or not self.signals[left.name].words:
            return None
        words = self.signals[left.name].words
        token = self.token
        if operator.text not in ("==", "!=") or token.kind != "name" or token.text not in words:
            self.refuse(
                token.at,
                f"{left.name} holds one of several words",
                ", ".join(words),
                f"write: {left.name} == {words[0]}",
            )
        self.take()
        return Condition(
            left.name, float(words.index(token.text)), operator.text == "!=", self.text[at : self.token.at].strip()
        )

    def _same(self, left: Expression, right: Expression, operator: _Token, verb: str) -> None:
        if left.dimension != right.dimension:
            self.refuse(
                operator.at,
                f"{units.words(left.dimension)} cannot be {verb} with {units.words(right.dimension)}",
                remedy="give each number its unit, as in: 25 MPa",
            )

    def _sum(self) -> object:
        node = self._product()
        while self.token.kind == "mark" and self.token.text in "+-":
            operator = self.take()
            other = self._value(self._product(), operator)
            node = self._value(node, operator)
            self._same(node, other, operator, "added to" if operator.text == "+" else "subtracted")
            node = Arithmetic(operator.text, (node, other), node.dimension)
        return node

    def _product(self) -> object:
        node = self._factor()
        while self.token.kind == "mark" and self.token.text in "*/":
            operator = self.take()
            other = self._value(self._factor(), operator)
            node = self._value(node, operator)
            sign = 1 if operator.text == "*" else -1
            node = Arithmetic(operator.text, (node, other), units.times(node.dimension, other.dimension, sign))
        return node

    def _value(self, node: object, operator: _Token) -> Expression:
        if not isinstance(node, (Number, Signal, Arithmetic)):
            self.refuse(operator.at, f"{operator.text} needs values on both sides")
        return node

    def _factor(self) -> object:
        token = self.token
        if token.kind == "number":
            self.take()
            unit = units.UNITS[token.unit or "1"]
            return Number(token.value * unit.factor, unit.dimension)
        if self.takes("-"):
            self._deeper(token.at)
            inner = self._value(self._factor(), token)
            self.depth -= 1
            return Arithmetic("neg", (inner,), inner.dimension)
        if self.takes("("):
            self._deeper(token.at)
            node = self._iff()
            self.expect("mark", ")")
            self.depth -= 1
            return node
        if token.kind == "name":
            return self._name()
        self.refuse(token.at, f"expected a value or a condition and found {token.text!r}")

    def _name(self) -> object:
        token = self.take()
        if token.text in ("true", "false"):
            return Constant(token.text == "true")
        if token.text in _FUNCTIONS and self.token.text == "(":
            return self._call(token)
        if token.text in self.signals:
            return Signal(token.text, self.signals[token.text].dimension)
        if token.text in _KEYWORDS:
            self.refuse(token.at, f"{token.text!r} is a word of the logic and stands in the wrong place")
        near = difflib.get_close_matches(token.text, self.signals, n=3)
        self.refuse(
            token.at,
            f"there is no signal {token.text!r}",
            ", ".join(near) if near else ", ".join(sorted(self.signals)[:12]),
            "`hilrunner check` lists the signals of a profile",
        )

    def _call(self, name: _Token) -> Expression:
        self._deeper(name.at)
        self.expect("mark", "(")
        operands = [self._value(self._sum(), name)]
        while self.takes(","):
            operands.append(self._value(self._sum(), name))
        self.expect("mark", ")")
        self.depth -= 1
        if len(operands) != _FUNCTIONS[name.text]:
            self.refuse(name.at, f"{name.text} takes {_FUNCTIONS[name.text]} values, not {len(operands)}")
        if len(operands) == 2:
            self._same(operands[0], operands[1], name, "compared")
        dimension = operands[0].dimension
        if name.text == "rate":
            dimension = units.times(dimension, units.UNITS["s"].dimension, -1)
        return Arithmetic(name.text, tuple(operands), dimension)

"""Hostile DBC files: the shipped one with numbers, names and structure replaced by what no tool exports, and files that only look like one."""

import re
from pathlib import Path

import numpy as np

from tests.attack.campaign import Attempt, Campaign, Tried
from tests.attack.outcome import call

DBC = Path(__file__).resolve().parents[2] / "firmware_iface" / "actuator.dbc"
EVIL = "\x1b]0;owned\x07\x1b[2J"
_NUMBERS = (
    "0", "-0", "-1", "1e999", "-1e999", "1e-999", "1e308", "1e-308", "nan", "inf", "9" * 400, "0.0000000000000000000000000001", "1.5",
    "65", "511", "512", "70000", "4294967295", "99999999999999999999", "", "0x10", "--1", "1e", "1,5", "²",
)  # fmt: skip
_NAMES = (
    "",
    EVIL,
    "a" * 100_000,
    "\x00",
    "é",
    "VECTOR__INDEPENDENT_SIG_MSG",
    "VALVE_COMMAND_1",
    "BO_",
    '"',
    "1x",
    "a b",
    "\u202e",
)
PROFILE = """name = "attacked"
[[axis]]
name = "luffing"
[bench]
engine = "reference"
[can]
dbc = "hostile.dbc"
"""


def numbers(rng, text: str) -> str:
    """Some numbers of mapped messages replaced."""
    places = [match.span() for match in re.finditer(r"(?<=[ :|@(,\[])-?\d+(?:\.\d+)?(?=[ |@,)\]:+-])", text)]
    for start, end in sorted(
        (places[k] for k in rng.integers(len(places), size=int(rng.integers(1, 6)))), reverse=True
    ):
        text = text[:start] + str(_NUMBERS[rng.integers(len(_NUMBERS))]) + text[end:]
    return text


def names(rng, text: str) -> str:
    """A name, a unit or a comment replaced."""
    places = [match.span(1) for match in re.finditer(r'(?:BO_ \d+ |SG_ |"|VAL_ \d+ )([\w%/ .]+)', text)]
    for start, end in sorted(
        (places[k] for k in rng.integers(len(places), size=int(rng.integers(1, 4)))), reverse=True
    ):
        text = text[:start] + str(_NAMES[rng.integers(len(_NAMES))]) + text[end:]
    return text


def lines(rng, text: str) -> str:
    """Lines left out, said twice, in another order, cut short."""
    rows = text.split("\n")
    kind = int(rng.integers(4))
    at = int(rng.integers(len(rows)))
    if kind == 0:
        del rows[at : at + int(rng.integers(1, 30))]
    elif kind == 1:
        rows[at:at] = rows[max(0, at - int(rng.integers(1, 30))) : at] * int(rng.integers(1, 5))
    elif kind == 2:
        rows = [rows[k] for k in rng.permutation(len(rows))]
    else:
        return text[: int(rng.integers(len(text)))]
    return "\n".join(rows)


def attributes(rng, text: str) -> str:
    """Protection, cycle times and start values of wrong types and absurd sizes."""
    value = str(
        rng.choice(["1e999", "-1", '"' + "9" * 5000 + '"', '"P02"', '""', "3.5", '"1 2 3"', "99999999999", '"x" "y"'])
    )
    places = list(re.finditer(r'(BA_ "\w+" (?:BO_|SG_) [\w ]+? )([^\s;]+)(;)', text))
    for match in sorted((places[k] for k in rng.integers(len(places), size=3)), key=lambda m: -m.start()):
        text = text[: match.start(2)] + value + text[match.end(2) :]
    return text


def structures(rng, text: str) -> str:
    """Messages of thousands of signals, deep multiplexing, messages twice, endless comments."""
    kind = int(rng.integers(6))
    if kind == 0:
        return (
            text
            + "\nBO_ 1 BIG: 8 ECU\n"
            + "".join(f' SG_ s{k} : {k % 64}|1@1+ (1,0) [0|1] "" ECU\n' for k in range(20_000))
        )
    if kind == 1:
        deep = "".join(f' SG_ m{k} m0M : {k % 60}|1@1+ (1,0) [0|1] "" ECU\n' for k in range(300))
        links = "".join(f"SG_MUL_VAL_ 2 m{k + 1} m{k} 0-0;\n" for k in range(299))
        return text + "\nBO_ 2 DEEP: 8 ECU\n" + deep + links
    if kind == 2:
        block = text[text.index("BO_ ") : text.index("\n\n", text.index("BO_ "))]
        return text + "\n" + block + "\n\n" + block
    if kind == 3:
        return text + '\nCM_ "' + "x" * 5_000_000
    if kind == 4:
        return text + "\nVAL_ 513 control " + " ".join(f'{k} "v{k}"' for k in range(50_000)) + ";\n"
    return "(" * 100_000 + text


def no_database(rng, text: str) -> str:
    """Other formats, binary, one endless line."""
    kinds = [
        "",
        "\x00" * 1000,
        "VERSION " + '"x" ' * 100_000,
        "<AUTOSAR>" * 10_000,
        "[V1]\n" * 1000,
        "a" * 3_000_000,
        EVIL * 100,
        "BO_ " * 50_000,
    ]
    return kinds[rng.integers(len(kinds))]


MAKERS = (numbers, numbers, names, lines, attributes, structures, no_database)


def prepare(folder: Path) -> Attempt:
    """`check` of a profile that names the file, in a folder of its own."""
    text = DBC.read_text()
    (folder / "attacked.toml").write_text(PROFILE)
    (folder / "hostile.dbc").write_text(text)
    from hilrunner import cli  # loads what a child needs

    assert cli.main(["check", str(folder / "attacked.toml"), "--json"]) == 0

    def attempt(rng: np.random.Generator, own: Path) -> Tried:
        maker = MAKERS[int(rng.integers(len(MAKERS)))]
        (own / "attacked.toml").write_text(PROFILE)
        (own / "hostile.dbc").write_text(maker(rng, text), encoding="utf-8", errors="surrogatepass")
        outcome = call(["check", str(own / "attacked.toml")])
        faults = outcome.faults()
        if outcome.code not in (0, 2):
            faults.append("an exit code that `check` does not have")
        name = maker.__name__
        return Tried(
            f"check with {name}", name, outcome.code, faults, outcome.wall_s, outcome.memory_bytes, outcome.err[-4000:]
        )

    return attempt


DATABASES = Campaign("databases", "hostile DBC files: numbers, names, structure", 1000, prepare)

"""Write actuator_messages.h and .c from ../actuator.dbc: structs, pack and unpack of every message. Needs cantools.

    python generate_messages.py              rewrites both files beside this script
    python generate_messages.py --check      exit 1 if they are not what the DBC gives

Messages of several axes must have one layout; they become one function with an `axis` argument.
"""

import argparse
import re
import sys
import textwrap
from pathlib import Path

import cantools

FOLDER = Path(__file__).resolve().parent
PROTECTION = ("crc8", "alive_counter")  # signals the end-to-end protection fills


class Message:
    """One kind of message: the DBC's messages NAME_1, NAME_2, ... with one layout."""

    def __init__(self, name: str, axes: dict[int, object]) -> None:
        self.name = name
        self.lower = name.lower()
        self.axes = [axes[number] for number in sorted(axes)]
        if sorted(axes) != list(range(1, len(axes) + 1)):
            raise SystemExit(f"{name}: axes {sorted(axes)} are not 1..{len(axes)}")
        self.first = self.axes[0]
        for other in self.axes[1:]:
            if layout(other) != layout(self.first) or other.length != self.first.length:
                raise SystemExit(f"{other.name}: layout differs from {self.first.name}")
        self.base_id = self.first.frame_id - 1
        if any(message.frame_id != self.base_id + axis for axis, message in enumerate(self.axes, 1)):
            raise SystemExit(f"{name}: identifiers are not consecutive")
        self.signals = [signal for signal in self.first.signals if signal.name not in PROTECTION]


def layout(message) -> list[tuple]:
    """What must be equal between axes."""
    return [
        (s.name, s.start, s.length, s.byte_order, s.is_signed, s.scale, s.offset, s.minimum, s.maximum, s.unit)
        for s in message.signals
    ]


def load(path: Path) -> list[Message]:
    """The kinds of messages of a DBC, in order of their identifiers."""
    kinds: dict[str, dict[int, object]] = {}
    for message in sorted(cantools.database.load_file(path).messages, key=lambda m: m.frame_id):
        name, axis = re.fullmatch(r"(\w+)_(\d+)", message.name).groups()
        kinds.setdefault(name, {})[int(axis)] = message
    return [Message(name, axes) for name, axes in kinds.items()]


def data_ids(message) -> str:
    """The Data ID list of one message as C values."""
    return ", ".join(message.dbc.attributes["E2EDataIdList"].value.split())


def is_real(signal) -> bool:
    """Signals with a scale are numbers with a fraction, the others are integers."""
    return signal.scale != 1 or signal.offset != 0


def is_listed(signal) -> bool:
    """Signals whose value table names every value of their range."""
    low, high = raw_range(signal)
    return bool(signal.choices) and all(value in signal.choices for value in range(low, high + 1))


def c_type(signal) -> str:
    """Type of the struct member."""
    if is_real(signal):
        return "actuator_real_t"
    bits = next(width for width in (8, 16, 32, 64) if signal.length <= width)
    return f"{'' if signal.is_signed else 'u'}int{bits}_t"


def raw_range(signal) -> tuple[int, int]:
    """Range in raw numbers: the DBC's, which the bits must hold."""
    if signal.length > 32:
        raise SystemExit(f"{signal.name}: {signal.length} bits, up to 32 are supported")
    low = round((signal.minimum - signal.offset) / signal.scale)
    high = round((signal.maximum - signal.offset) / signal.scale)
    full = (
        (-(1 << signal.length - 1), (1 << signal.length - 1) - 1) if signal.is_signed else (0, (1 << signal.length) - 1)
    )
    if not full[0] <= low <= high <= full[1]:
        raise SystemExit(f"{signal.name}: range [{signal.minimum}|{signal.maximum}] does not fit {signal.length} bits")
    return low, high


def segments(signal) -> list[tuple[int, int, int, int]]:
    """(byte, shift, mask, raw place) of each byte a little-endian signal touches."""
    if signal.byte_order != "little_endian":
        raise SystemExit(f"{signal.name}: only little-endian signals")
    out = []
    raw = 0
    while raw < signal.length:
        byte, shift = divmod(signal.start + raw, 8)
        width = min(8 - shift, signal.length - raw)
        out.append((byte, shift, (1 << width) - 1, raw))
        raw += width
    return out


def shifted(text: str, left: int, right: int) -> str:
    """`text` shifted, without a shift by nothing."""
    if left:
        return f"({text} << {left})"
    return f"({text} >> {right})" if right else text


def comment(text: str, indent: str = "") -> list[str]:
    """Lines of a C comment, 118 columns at most."""
    words = " ".join((text or "").split()).replace("*/", "* /")
    lines = textwrap.wrap(words, 118 - len(indent) - 6, break_long_words=False)
    lines = [f"{indent}/* {lines[0]}"] + [f"{indent} * {line}" for line in lines[1:]]
    lines[-1] += " */"
    return lines


NOTICE = "/* Written by generate_messages.py from actuator.dbc; change the DBC and run it again. */\n"


def header(kinds: list[Message]) -> str:
    """actuator_messages.h."""
    axis_count = min(len(kind.axes) for kind in kinds)
    out = [
        NOTICE,
        "/* Messages between a motion-control firmware and the actuator bench: values <-> bytes, protected by E2E profile 2.",
        " *",
        " * pack: clamps every number to the range of the DBC (NaN is sent as the one nearest to 0; a value outside its value",
        " *   table as the start value), moves the counter on, writes counter and CRC. Rounds half to even. `counter`",
        " *   belongs to the caller, one a message, 0 at first.",
        " * unpack: FRAME_VALID, or why the frame must not be used; then `values` and (but for the resynchronisation told in",
        " *   e2e_p02.h) the receiver are as before.",
        " * axis: 1.."
        + str(axis_count)
        + "; anything else packs nothing and returns 0, or unpacks to FRAME_UNKNOWN_ID.",
        " * No heap, no globals, no floating-point environment, nothing blocks. */",
        "#ifndef ACTUATOR_MESSAGES_H",
        "#define ACTUATOR_MESSAGES_H",
        "",
        "#include <stddef.h>",
        "#include <stdint.h>",
        "",
        '#include "e2e_p02.h"',
        "",
        "/* float would lose the last digit of a position beyond 8 m */",
        "#ifndef ACTUATOR_REAL",
        "#define ACTUATOR_REAL double",
        "#endif",
        "typedef ACTUATOR_REAL actuator_real_t;",
        "",
        f"#define ACTUATOR_AXIS_COUNT {axis_count}",
        "",
    ]
    for kind in kinds:
        out += message_header(kind)
    out += ["#endif", ""]
    return "\n".join(out)


def message_header(kind: Message) -> list[str]:
    """Constants, enums, struct and prototypes of one message."""
    upper = f"ACTUATOR_{kind.name}"
    way = f"{kind.first.senders[0]} -> {', '.join(kind.first.receivers)}"
    out = [
        *comment(f"{kind.name}_k, {way}: {kind.first.comment}"),
        f"#define {upper}_ID(axis) (0x{kind.base_id:03X}u + (axis))",
        f"#define {upper}_LENGTH {kind.first.length}",
        f"#define {upper}_CYCLE_MS {kind.first.cycle_time}",
        "",
    ]
    for signal in kind.signals:
        if signal.choices:
            prefix = f"ACTUATOR_{signal.name.upper()}_"
            names = [
                f"    {prefix}{re.sub(r'[^A-Z0-9]+', '_', str(text).upper())} = {value}"
                for value, text in sorted(signal.choices.items())
            ]
            out += ["enum {", ",\n".join(names), "};", ""]
    out.append("typedef struct {")
    for signal in kind.signals:
        unit = f"{signal.unit}, " if signal.unit else ""
        limits = f"[{signal.minimum}, {signal.maximum}]"
        out += comment(f"{unit}{limits}. {signal.comment}", "    ")
        out.append(f"    {c_type(signal)} {signal.name};")
    out += [f"}} actuator_{kind.lower}_t;", "", f"{pack_prototype(kind)};", f"{unpack_prototype(kind)};", ""]
    return out


def pack_prototype(kind: Message) -> str:
    """Declaration of pack."""
    return (
        f"size_t actuator_{kind.lower}_pack(uint8_t *data, unsigned axis, uint8_t *counter,\n"
        f"    const actuator_{kind.lower}_t *values)"
    )


def unpack_prototype(kind: Message) -> str:
    """Declaration of unpack."""
    return (
        f"frame_status_t actuator_{kind.lower}_unpack(const uint8_t *data, size_t length, unsigned axis,\n"
        f"    e2e_p02_receiver_t *receiver, actuator_{kind.lower}_t *values)"
    )


NEXT = "\n        "

HELPERS = """
#define REAL(number) ((actuator_real_t)(number))

/* Nearest whole number, ties to even, of a number within the range of int32. */
static int64_t whole(actuator_real_t number)
{
    int64_t below = (int64_t)number;
    if ((actuator_real_t)below > number) {
        below--;
    }
    actuator_real_t rest = number - (actuator_real_t)below;
    if (rest > REAL(0.5) || (rest == REAL(0.5) && below % 2 != 0)) {
        below++;
    }
    return below;
}

/* Raw number of a physical value, clamped; NaN becomes the raw number nearest to 0. */
static int64_t raw_of(actuator_real_t value, actuator_real_t scale, actuator_real_t offset, int64_t low, int64_t high)
{
    actuator_real_t number = (value - offset) / scale;
    if (!(number == number)) {
        number = 0;
    }
    if (number <= (actuator_real_t)low) {
        return low;
    }
    if (number >= (actuator_real_t)high) {
        return high;
    }
    return whole(number);
}

static int64_t clamped(int64_t value, int64_t low, int64_t high)
{
    return value < low ? low : value > high ? high : value;
}

/* A value outside its value table means nothing, least of all its neighbour: the start value is sent. */
static int64_t listed(int64_t value, int64_t low, int64_t high, int64_t start)
{
    return value < low || value > high ? start : value;
}
"""


def source(kinds: list[Message]) -> str:
    """actuator_messages.c."""
    out = [NOTICE + '#include "actuator_messages.h"\n' + HELPERS]
    for kind in kinds:
        rows = ",\n".join(f"    {{{data_ids(message)}}}" for message in kind.axes)
        out.append(
            f"static const uint8_t {kind.lower}_data_ids[{len(kind.axes)}][E2E_P02_COUNTER_MODULUS] = {{\n{rows},\n}};\n"
        )
        out.append(pack_source(kind))
        out.append(unpack_source(kind))
    return "\n".join(out)


def pack_source(kind: Message) -> str:
    """Definition of pack."""
    length = kind.first.length
    out = [
        pack_prototype(kind),
        "{",
        f"    if (axis < 1 || axis > {len(kind.axes)}) {{",
        "        return 0;",
        "    }",
        f"    for (size_t index = 0; index < {length}; index++) {{",
        "        data[index] = 0;",
        "    }",
    ]
    for signal in kind.signals:
        low, high = raw_range(signal)
        raw = f"{signal.name}_raw"
        if is_real(signal):
            scale, offset = (f"REAL({float(value)!r})" for value in (signal.scale, signal.offset))
            value = f"raw_of({NEXT}values->{signal.name}, {scale}, {offset}, {low}, {high})"
        elif is_listed(signal):
            value = f"listed((int64_t)values->{signal.name}, {low}, {high}, {int(signal.raw_initial or 0)})"
        else:
            value = f"clamped((int64_t)values->{signal.name}, {low}, {high})"
        out.append(f"    uint64_t {raw} = (uint64_t){value};")
        for byte, shift, mask, place in segments(signal):
            part = shifted(f"({shifted(raw, 0, place)} & 0x{mask:X}u)", shift, 0)
            out.append(f"    data[{byte}] = (uint8_t)(data[{byte}] | {part});")
    out += [
        f"    e2e_p02_protect(data, {length}, {kind.lower}_data_ids[axis - 1], counter);",
        f"    return {length};",
        "}",
        "",
    ]
    return "\n".join(out)


def unpack_source(kind: Message) -> str:
    """Definition of unpack."""
    length = kind.first.length
    out = [
        unpack_prototype(kind),
        "{",
        f"    if (axis < 1 || axis > {len(kind.axes)}) {{",
        "        return FRAME_UNKNOWN_ID;",
        "    }",
        f"    if (length != {length}) {{",
        "        return FRAME_WRONG_LENGTH;",
        "    }",
        f"    frame_status_t status = e2e_p02_check(receiver, data, {length}, {kind.lower}_data_ids[axis - 1]);",
        "    if (status != FRAME_VALID) {",
        "        return status;",
        "    }",
    ]
    checks: list[str] = []
    lists: list[str] = []
    stores: list[str] = []
    for signal in kind.signals:
        low, high = raw_range(signal)
        raw = f"{signal.name}_raw"
        parts = [
            shifted(f"(uint64_t)({shifted(f'data[{byte}]', 0, shift)} & 0x{mask:X}u)", place, 0)
            for byte, shift, mask, place in segments(signal)
        ]
        out.append(f"    uint64_t {signal.name}_bits = {f'{NEXT}| '.join(parts)};")
        value = f"(int64_t){signal.name}_bits"
        if signal.is_signed:
            sign = f"0x{1 << signal.length - 1:X}"
            value = f"(int64_t)({signal.name}_bits ^ {sign}u) - {sign}"
        out.append(f"    int64_t {raw} = {value};")
        full = (
            (-(1 << signal.length - 1), (1 << signal.length - 1) - 1)
            if signal.is_signed
            else (0, (1 << signal.length) - 1)
        )
        target = lists if is_listed(signal) else checks
        if low > full[0]:
            target.append(f"{raw} < {low}")
        if high < full[1]:
            target.append(f"{raw} > {high}")
        if is_real(signal):
            scale, offset = (f"REAL({float(number)!r})" for number in (signal.scale, signal.offset))
            stores.append(f"    values->{signal.name} = (actuator_real_t){raw} * {scale} + {offset};")
        else:
            stores.append(f"    values->{signal.name} = ({c_type(signal)}){raw};")
    if checks:
        out += [f"    if ({' || '.join(checks)}) {{", "        return FRAME_OUT_OF_RANGE;", "    }"]
    if lists:
        out += [f"    if ({' || '.join(lists)}) {{", "        return FRAME_BAD_CONTROL;", "    }"]
    out += stores
    out += ["    e2e_p02_accept(receiver, data);", "    return FRAME_VALID;", "}", ""]
    return "\n".join(out)


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dbc", type=Path, default=FOLDER.parent / "actuator.dbc")
    parser.add_argument("--out", type=Path, default=FOLDER)
    parser.add_argument("--check", action="store_true", help="compare instead of writing")
    arguments = parser.parse_args()
    kinds = load(arguments.dbc)
    texts = {"actuator_messages.h": header(kinds), "actuator_messages.c": source(kinds)}
    for name, text in texts.items():
        path = arguments.out / name
        if not arguments.check:
            path.write_text(text, encoding="utf-8")
        elif not path.exists() or path.read_text(encoding="utf-8") != text:
            print(f"{path}: not what {arguments.dbc.name} gives; run generate_messages.py", file=sys.stderr)
            return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

"""DBC files of any layout for tests: text in, path out."""

from typing import NamedTuple


class Sig(NamedTuple):
    """One signal; start as a DBC gives it (little-endian: lowest bit, big-endian: highest bit)."""

    name: str
    start: int
    length: int
    big_endian: bool = False
    signed: bool = False
    scale: str = "1"
    offset: str = "0"
    minimum: str = "0"
    maximum: str = "0"
    unit: str = ""
    float_bits: int = 0
    multiplex: str = ""

    def text(self) -> str:
        order = f"{0 if self.big_endian else 1}{'-' if self.signed or self.float_bits else '+'}"
        return (
            f" SG_ {self.name} {self.multiplex}: {self.start}|{self.length}@{order} ({self.scale},{self.offset}) "
            f'[{self.minimum}|{self.maximum}] "{self.unit}" BENCH'
        )


class Msg(NamedTuple):
    """One message."""

    name: str
    can_id: int
    length: int
    signals: list[Sig]
    extended: bool = False
    cycle_ms: int | None = None
    data_ids: str = ""
    profile: str = "P02"
    starts: tuple[tuple[str, int], ...] = ()

    @property
    def number(self) -> int:
        return self.can_id | (0x80000000 if self.extended else 0)


def text(messages: list[Msg]) -> str:
    """The DBC."""
    out = ['VERSION ""', "NS_ :", "BS_:", "BU_: FIRMWARE BENCH"]
    for message in messages:
        out.append(f"BO_ {message.number} {message.name}: {message.length} FIRMWARE")
        out += [signal.text() for signal in message.signals] + [""]
    out += [
        'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;',
        'BA_DEF_ BO_ "E2EProfile" STRING ;',
        'BA_DEF_ BO_ "E2EDataIdList" STRING ;',
        'BA_DEF_ SG_ "GenSigStartValue" INT -2147483648 2147483647;',
        'BA_DEF_DEF_ "GenMsgCycleTime" 0;',
        'BA_DEF_DEF_ "E2EProfile" "";',
        'BA_DEF_DEF_ "E2EDataIdList" "";',
        'BA_DEF_DEF_ "GenSigStartValue" 0;',
    ]
    for message in messages:
        if message.cycle_ms is not None:
            out.append(f'BA_ "GenMsgCycleTime" BO_ {message.number} {message.cycle_ms};')
        if message.data_ids:
            out.append(f'BA_ "E2EProfile" BO_ {message.number} "{message.profile}";')
            out.append(f'BA_ "E2EDataIdList" BO_ {message.number} "{message.data_ids}";')
        for name, value in message.starts:
            out.append(f'BA_ "GenSigStartValue" SG_ {message.number} {name} {value};')
        for signal in message.signals:
            if signal.float_bits:
                out.append(f"SIG_VALTYPE_ {message.number} {signal.name} : {1 if signal.float_bits == 32 else 2};")
    return "\n".join(out) + "\n"


def write(folder, messages: list[Msg]):
    """Path of a DBC with these messages."""
    path = folder / "own.dbc"
    path.write_text(text(messages), encoding="utf-8")
    return path

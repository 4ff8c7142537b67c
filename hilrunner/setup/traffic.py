"""The frames a profile puts on the bus, for its load: commands and measurements as the DBC's cycle times and the mapping say."""

from hilrunner.base.units import NS_PER_MS, NS_PER_S
from hilrunner.realtime.decode import CommandTable
from hilrunner.realtime.encode import MeasurementTable
from hilrunner.setup.contract import wiring
from hilrunner.setup.host_can import FrameTraffic
from hilrunner.setup.profile import LoadedProfile

_EFF = 1 << 31


def table_traffic(
    commands: CommandTable,
    measurements: MeasurementTable,
    period_ns: int,
    fd: bool = False,
    command_cycles_ns: list[int] | None = None,
) -> list[FrameTraffic]:
    """Frames a second of both tables.

    Args:
        command_cycles_ns: one a command message; None or 0: the firmware is taken to send every period, the most a bench can use.
    """
    ticks_per_s = NS_PER_S / period_ns
    cycles = command_cycles_ns or [0] * len(commands.can_id)
    traffic = [
        FrameTraffic(NS_PER_S / cycle if cycle else ticks_per_s, int(length), bool(int(can_id) & _EFF), fd)
        for can_id, length, cycle in zip(commands.can_id, commands.length, cycles, strict=True)
    ]
    for message in range(measurements.message_count):
        traffic.append(
            FrameTraffic(
                ticks_per_s / int(measurements.period_ticks[message]),
                int(measurements.length[message]),
                bool(int(measurements.can_id[message]) & _EFF),
                bool(measurements.fd[message]),
            )
        )
    return traffic


def profile_traffic(loaded: LoadedProfile, period_ns: int) -> list[FrameTraffic]:
    """Frames of a profile's bus.

    Raises:
        DbcError: the DBC or the mapping is refused.
    """
    understood = wiring(loaded)
    cycles_ns = [round(max(facts.cycle_ms or 0, 0) * NS_PER_MS) for facts in understood.received_facts]
    fd = loaded.profile.can.fd
    return table_traffic(understood.commands, understood.measurements, period_ns, fd, cycles_ns)

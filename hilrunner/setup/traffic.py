"""The frames a profile puts on the bus, for its load: commands every period, measurements as the DBC's cycle times say."""

from hilrunner.base.units import NS_PER_S
from hilrunner.realtime.decode import CommandTable
from hilrunner.realtime.encode import MeasurementTable
from hilrunner.setup.contract import signal_tables
from hilrunner.setup.host_can import FrameTraffic
from hilrunner.setup.profile import LoadedProfile

_EFF = 1 << 31


def table_traffic(
    commands: CommandTable, measurements: MeasurementTable, period_ns: int, fd: bool = False
) -> list[FrameTraffic]:
    """Frames a second of both tables; the firmware is taken to send a command every period, the most a bench can use."""
    ticks_per_s = NS_PER_S / period_ns
    traffic = [
        FrameTraffic(ticks_per_s, int(length), bool(int(can_id) & _EFF), fd)
        for can_id, length in zip(commands.can_id, commands.length, strict=True)
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
    commands, measurements = signal_tables(loaded)
    return table_traffic(commands, measurements, period_ns, loaded.profile.can.fd)

"""The live view: a Foxglove WebSocket server in the recorder, fed at a decimated rate, never from the loop.

Topics, schemas and payloads are those of the log, so one layout serves both. Listens on this machine only; from another
one, tunnel the port (`ssh -L 8765:localhost:8765 bench`).
"""

import logging
import threading

import foxglove
import numpy as np

from hilrunner.base import records
from hilrunner.base.units import NS_PER_S
from hilrunner.record import schemas
from hilrunner.record.config import RecorderConfig
from hilrunner.record.live_port import HOST, refusal
from hilrunner.record.mcap_log import log_message

CLOSE_WAIT_S = 1.0
MISSES_A_CALL_MAX = 20  # a burst is in the log; the viewer needs to see that there is one


class _Decimator:
    """Picks the first tick at or behind each multiple of a stride."""

    def __init__(self, stride_ticks: int) -> None:
        self._stride_ticks = stride_ticks
        self._bin = -1

    def places(self, ticks: np.ndarray) -> list[int]:
        """Places of the ticks to show in a batch that follows the one before."""
        bins = ticks.astype(np.int64) // self._stride_ticks
        chosen = np.flatnonzero(np.diff(bins, prepend=self._bin) > 0)
        self._bin = int(bins[-1]) if len(bins) else self._bin
        return chosen.tolist()


class LiveView:
    """Serves the run on `settings.live_port` (0: any free port)."""

    def __init__(self, settings: RecorderConfig) -> None:
        logging.getLogger("foxglove").setLevel(logging.CRITICAL)  # clients come and go; stderr is for failures
        self._settings = settings
        stride_ticks = max(1, round(NS_PER_S / (settings.live_hz * settings.period_ns)))
        self._ticks = _Decimator(stride_ticks)
        self._checks = {name: _Decimator(stride_ticks) for name in settings.axis_names}
        self._context = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        self._add("/rt/tick", "Tick", records.TICK)
        for name in settings.axis_names:
            self._add(f"/{name}/command", "Command", records.COMMAND)
            self._add(f"/{name}/state", "State", records.STATE)
            self._add(f"/{name}/check", "Check", records.CHECK)
        self._add("/rt/miss", "Miss", records.MISS)
        self._add("/rt/statistics", "Statistics", records.STATISTICS)
        log_schema = foxglove.Schema(
            name=schemas.LOG_SCHEMA_NAME, encoding="ros2msg", data=schemas.LOG_SCHEMA_TEXT.encode()
        )
        self._events = foxglove.Channel("/log", schema=log_schema, message_encoding="cdr", context=self._context)
        try:
            self._server = foxglove.start_server(
                name="hilrunner", host=HOST, port=settings.live_port, context=self._context
            )
        except Exception as error:  # the SDK has one error type for all of it
            raise refusal(settings.live_port, str(error)) from error
        self.port = self._server.port

    def take_ticks(self, tick: np.ndarray, command: np.ndarray, state: np.ndarray, log_real_ns: np.ndarray) -> None:
        """Whole periods, in order; at most live_hz of them a second are shown."""
        axes = len(self._settings.axis_names)
        for place in self._ticks.places(tick["tick"]):
            real_ns = int(log_real_ns[place])
            self._send("/rt/tick", tick[place], real_ns)
            for axis, name in enumerate(self._settings.axis_names):
                self._send(f"/{name}/command", command[place * axes + axis], real_ns)
                self._send(f"/{name}/state", state[place * axes + axis], real_ns)

    def take_check(self, axis_name: str, check: np.ndarray, log_real_ns: np.ndarray) -> None:
        """Results of the cross-check, in order; shown like the ticks."""
        for place in self._checks[axis_name].places(check["tick"]):
            self._send(f"/{axis_name}/check", check[place], int(log_real_ns[place]))

    def take_misses(self, miss: np.ndarray, log_real_ns: np.ndarray) -> None:
        """The first misses of a batch."""
        for place in range(min(len(miss), MISSES_A_CALL_MAX)):
            self._send("/rt/miss", miss[place], int(log_real_ns[place]))

    def take_statistics(self, statistics: np.ndarray, log_real_ns: int) -> None:
        """Percentiles so far."""
        self._send("/rt/statistics", statistics[0], log_real_ns)

    def take_event(self, level: int, name: str, text: str, real_ns: int) -> None:
        """An event in words."""
        self._events.log(log_message(level, name, text, real_ns), log_time=real_ns)

    def close(self) -> None:
        """End the server; clients are told, unless one that does not read holds it up."""
        stopping = threading.Thread(target=self._server.stop, daemon=True)
        stopping.start()
        stopping.join(CLOSE_WAIT_S)

    def _send(self, topic: str, record: np.void, real_ns: int) -> None:
        self._channels[topic].log(record.tobytes()[records.MESSAGE_OFFSET :], log_time=real_ns)

    def _add(self, topic: str, message: str, dtype: np.dtype) -> None:
        text = schemas.schema_text(message, dtype).encode()
        schema = foxglove.Schema(name=f"hilrunner/msg/{message}", encoding="ros2msg", data=text)
        self._channels[topic] = foxglove.Channel(topic, schema=schema, message_encoding="cdr", context=self._context)

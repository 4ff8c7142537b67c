"""What a person sees of a run: findings at the start, one live line on a terminal, a summary at the end."""

import sys

from hilrunner.base import histogram_scale, records, state_layout, status
from hilrunner.base.plain_text import plain_line
from hilrunner.base.units import M_PER_MM, PA_PER_MPA
from hilrunner.commands.plain_streams import beneath
from hilrunner.commands.run_summary import worst_us
from hilrunner.commands.run_waiting import waits_for
from hilrunner.setup.contract import wiring
from hilrunner.setup.session import Session
from hilrunner.setup.wire_span import bench_warnings

_ALSO_DROPPED = (("dropped_frames", "frames"), ("dropped_misses", "misses"))
_WAKE = records.HISTOGRAM_NAMES.index("wake_lateness")


def print_start(session: Session) -> None:
    """Profile, plant, bus, rights and how long the start took."""
    profile = session.loaded.profile
    axes = session.axes
    print(f"hilrunner: profile {profile.name}, {len(profile.axis)} axis, period {profile.bench.period_us} us")
    for axis, plant, state in zip(profile.axis, axes.plants, axes.initial_states, strict=True):
        print(
            f"  axis {axis.name}: circuit {axis.circuit}, engine {status.ENGINE_NAMES[plant.engine]}, "
            f"{plant.substep_count} substeps, start {state[state_layout.ROD_POSITION] / M_PER_MM:.1f} mm, "
            f"p1 {state[state_layout.CHAMBER_1_PRESSURE] / PA_PER_MPA:.3f} MPa"
        )
    for report in axes.model_reports:
        print("  " + report.text().replace("\n", "\n    "))
    for warning in bench_warnings(session.loaded, axes):
        print(f"  warning: {warning}")
    stimulus = session.options.stimulus_facts
    if stimulus is not None:
        print(f"  {stimulus.text()}")
        for warning in stimulus.warnings:
            print(f"  warning: {warning}")
    if session.world is not None:
        for one in session.world.firmware:
            print(f"  virtual time, firmware: {plain_line(' '.join(one.command))}", flush=True)
        return
    print(f"  bus: {session.bus.name if session.bus else 'none (stimulus)'}")
    refused = [grant for grant in session.grants if not grant.granted]
    print(f"  real time: {len(session.grants) - len(refused)} of {len(session.grants)} asked for were granted")
    for grant in refused:
        print(f"    refused: {grant.name} ({grant.reason}); remedy: {grant.remedy or 'none'}")
    start_s = (session.start_mono_ns - session.begin_mono_ns) * 1e-9
    print(f"  first tick {start_s:.2f} s after the command", flush=True)


class LiveLine:
    """One line on a terminal, rewritten in place: seconds, u, x, p1, p2, lateness p99, misses, and what the bench waits for."""

    def __init__(self, session: Session, enabled: bool) -> None:
        self.session = session
        self.enabled = enabled
        self._shown = False
        self._period_s = session.loaded.profile.bench.period_us * 1e-6
        self._messages = [facts.name for facts in wiring(session.loaded).received_facts] if enabled else []

    def update(self) -> None:
        """Rewrite the line from the loop's own arrays; a value may be one tick old."""
        if not self.enabled:
            return
        bench = self.session.armed.bench
        state = bench.state[0]
        late = histogram_scale.quantile_ns(bench.ring.histogram[_WAKE], bench.ring.extreme[_WAKE], 0.99)
        line = (
            f"{int(bench.progress[0]['tick'] + 1) * self._period_s:9.1f} s  {status.MODE_NAMES[int(bench.commands[0]['mode'])]:<10} "
            f"u {float(bench.commands[0]['applied']):+.3f}  x {state[state_layout.ROD_POSITION] / M_PER_MM:9.3f} mm  "
            f"p1 {state[state_layout.CHAMBER_1_PRESSURE] / PA_PER_MPA:7.3f}  "
            f"p2 {state[state_layout.CHAMBER_2_PRESSURE] / PA_PER_MPA:7.3f} MPa  "
            f"late p99 {late / 1000:.0f} us  misses {int(bench.progress[0]['miss_count'])}"
        )
        if self.session.bus is not None and (waited := waits_for(bench, self._messages)):
            line += f"  {waited}"
        terminal = beneath(sys.stderr)
        terminal.write("\r\x1b[2K" + line)
        terminal.flush()
        self._shown = True

    def tell(self, sentences: list[str]) -> None:
        """What has befallen the run, a line each; told also where no live line is wanted."""
        if sentences:
            self.close()
            self._shown = False
        for text in sentences:
            sys.stderr.write(f"hilrunner: {text}\n")
        if sentences:
            sys.stderr.flush()

    def close(self) -> None:
        """Leave the terminal on a fresh line."""
        if self._shown:
            sys.stderr.write("\n")
            sys.stderr.flush()


def print_summary(summary: dict) -> None:
    """The end of a run, for people."""
    latency = summary["latency_ns"]
    print(
        f"run ended: {summary['exit_reason']}"
        + (f" ({summary['bus_error']})" if summary["bus_error"] else "")
        + f"; {summary['tick_count']} ticks, {summary['duration_s']:.3f} s, mode: {summary['mode']}"
    )
    print(
        f"  deadlines: {summary['miss_count']} missed, {summary['skipped_count']} periods skipped "
        f"(after {summary['warm_up_ticks']} warm-up ticks)"
    )
    print(f"  {'us':18s} {'p50':>9s} {'p99':>9s} {'p99.9':>9s} {'max':>9s}")
    for name, label in (
        ("wake_lateness", "wake-up lateness"),
        ("execution", "execution"),
        ("step", "  of it plant step"),
        ("command_age", "command age"),
        ("response", "command->response"),
    ):
        if name in latency:
            figures = " ".join(f"{worst_us(latency, name, key):>9s}" for key in ("p50", "p99", "p999", "max"))
            print(f"  {label:18s} {figures}")
    print(
        f"  frames: {summary['frames_received']} received, {summary['frames_sent']} sent, "
        f"{summary['frames_unsent']} not sent, {summary['frames_kernel_dropped']} dropped by the kernel"
    )
    for name, counts in summary["frames"].items():
        if counts:
            print(f"    {name}: " + ", ".join(f"{count} {text}" for text, count in counts.items()))
    for one in summary["unknown_ids"][:8]:
        hint = f": {one['hint']}" if one["hint"] else ""
        print(f"    {one['id']} arrived {one['count']} times, {one['rate_hz']:g} Hz, and is mapped to nothing{hint}")
    if summary["clamped"]:
        told = ", ".join(f"{name} {count} times" for name, count in summary["clamped"].items())
        print(f"    sent as the end of the signal's range, because the value lies outside: {told}")
    for axis in summary["axes"]:
        print(
            f"  {axis['name']}: {axis['mode']}, x {axis['rod_position_mm']:.3f} mm, "
            f"p1 {axis['chamber_1_pressure_mpa']:.3f} MPa, p2 {axis['chamber_2_pressure_mpa']:.3f} MPa"
        )
    if summary["flags"]:
        print(f"  seen: {', '.join(summary['flags'])}")
    stall = summary["stall"]
    if stall["count"]:
        print(
            f"  stalls: {stall['count']} longer than {stall['limit_ms']} ms, longest {stall['longest_ms']:.1f} ms, "
            f"first before tick {stall['first_tick']}"
        )
    _print_recorder(summary)
    for one in summary["firmware"]:
        print(f"  firmware {plain_line(' '.join(one['command']))}: {one['said']}")
    for text in summary["engine_errors"]:
        print(f"  {text}")
    _print_verdict(summary["verdict"])
    if summary.get("signed"):
        print(f"  {summary['signed']}")
    print(f"  exit code {summary['exit_code']}")


def _print_verdict(verdict: dict) -> None:
    """The outcome and everything that failed, the cause of the exit code first."""
    print(f"  verdict: {verdict['outcome'] if verdict['exit_code'] == 0 else verdict['outcome'].upper()}")
    for text in verdict["causes"]:
        print(f"    {text}")


def _print_recorder(summary: dict) -> None:
    recorder = summary["recorder"]
    if not recorder:
        return
    if recorder.get("error"):
        print(f"  recorder: {': '.join(part for part in recorder['error'] if part)}")
        return
    if recorder["log_path"] is None:
        print(f"  log: none kept; {recorder['tick_count']} ticks taken, {_dropped_text(recorder)}")
    else:
        print(
            f"  log: {recorder['log_path']}, {recorder['tick_count']} ticks, {recorder['size_bytes'] / 1e6:.2f} MB, "
            f"{_dropped_text(recorder)}, {recorder['lost_bytes']} bytes lost"
        )
    for text in recorder.get("log_lacks", ()):
        print(f"  the log is not whole: {text}")
    for name, figures in (recorder.get("check") or {}).items():
        if isinstance(figures, dict) and figures.get("checked_ticks"):
            print(f"  cross-check {name}: {_check_text(figures)}")
    if summary["check_failed_tick"] is not None:
        print(f"  cross-check: out of tolerance at tick {summary['check_failed_tick']}")


def _dropped_text(recorder: dict) -> str:
    """What the ring had no room for: ticks always, frames and misses where there are any."""
    told = [f"{recorder['dropped_ticks']} ticks dropped"]
    told += [f"{recorder[key]} {noun} dropped" for key, noun in _ALSO_DROPPED if recorder[key]]
    return ", ".join(told)


def _check_text(figures: dict) -> str:
    """Largest distances from the first-principle model: free-running beside the run, and over one step."""
    free = (
        f"p1 {figures['chamber_1_pressure_error_pa_max'] / PA_PER_MPA:.2e} MPa, "
        f"p2 {figures['chamber_2_pressure_error_pa_max'] / PA_PER_MPA:.2e} MPa, "
        f"x {figures['rod_position_error_m_max'] / M_PER_MM:.2e} mm"
    )
    step = max(figures["one_step_chamber_1_pressure_error_pa_max"], figures["one_step_chamber_2_pressure_error_pa_max"])
    return f"{free} from the first-principle model over {figures['checked_ticks']} ticks; one step {step / PA_PER_MPA:.2e} MPa"

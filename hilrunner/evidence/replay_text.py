"""The replay as text."""

from hilrunner.evidence.replay import Replay, speed
from hilrunner.evidence.replay_dae import AxisDae
from hilrunner.evidence.replay_exact import ExactReplay, exact_sentence
from hilrunner.evidence.report_text import align, verdict_words


def replay_text(replay: Replay) -> str:
    """The whole result."""
    parts = [f"{replay.path}: profile {replay.facts.profile_name}, engine {replay.facts.provenance.get('engine', '?')}"]
    causes = [f"  {cause}" for cause in replay.verdict.causes]
    parts.append("\n".join([f"verdict: {verdict_words(replay.verdict)}", *causes]))
    if replay.exact is not None:
        parts.append(exact_text(replay.exact))
    parts += [axis_text(axis) for axis in replay.axes]
    if replay.notes:
        parts.append("\n".join(["what the log lacks:", *(f"  {note}" for note in replay.notes)]))
    return "\n\n".join(parts) + "\n"


def exact_text(exact: ExactReplay) -> str:
    """The bit-exact replay in full."""
    lines = [exact_sentence(exact)]
    lines += [f"  {name}: {count} ticks differ" for name, count in exact.differing.items()]
    lines.append(
        f"  {exact.simulated_s:.1f} s replayed in {exact.wall_s:.2f} s: {exact.speed_factor:.0f} times real time "
        f"({exact.processor_s:.2f} s of processor: {exact.processor_factor:.0f} times)"
    )
    lines += [f"  {note}" for note in exact.notes]
    return "\n".join(lines)


def figure_rows(axis: AxisDae) -> list[list[str]]:
    """Head and one row a quantity and comparison."""
    rows = [["", "", "max", "RMS", "unit", "max / range", "RMS / range", "worst at tick"]]
    for one in axis.figures:
        values = [
            f"{one.max:.3g}",
            f"{one.rms:.3g}",
            one.unit,
            f"{one.max_normalised:.2e}",
            f"{one.rms_normalised:.2e}",
        ]
        rows.append([one.quantity, one.comparison, *values, str(one.worst_tick)])
    return rows


def place_rows(axis: AxisDae) -> list[list[str]]:
    """Head and one row an input of a network: where the largest one-step error sat."""
    rows = [["network", "input", "low", "at worst", "high", "share of range"]]
    for place in axis.places:
        numbers = [f"{value:.5g}" for value in (place.low, place.at_worst, place.high)]
        rows.append([place.network, place.name, *numbers, f"{place.share_at_worst:.3f}"])
    return rows


def axis_text(axis: AxisDae) -> str:
    """One axis against the full model."""
    state = "all within the profile's tolerance"
    if axis.out_of_tolerance:
        state = f"{axis.out_of_tolerance} OUT OF TOLERANCE, first at tick {axis.first_out_tick}"
    lines = [f"full model of {axis.axis}: {len(axis.tick)} ticks, {state}", align(figure_rows(axis), left=2)]
    if axis.places:
        lines += ["  largest one-step pressure error within the training range:", align(place_rows(axis), left=2)]
    lines.append(
        f"  IDA {axis.simulated_s:.1f} s in {axis.ida_wall_s:.2f} s: {speed(axis.simulated_s, axis.ida_wall_s):.1f} times real time; "
        f"compiled reference in {axis.reference_wall_s:.2f} s: {speed(axis.simulated_s, axis.reference_wall_s):.1f} times"
    )
    lines += [f"  {note}" for note in axis.notes]
    return "\n".join(lines)

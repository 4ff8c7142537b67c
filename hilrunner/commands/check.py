"""Validate a profile: keys, units and relations, DBC, trained model, stability of the integrator, bus load."""

import argparse
import json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `hilrunner check`."""
    parser.add_argument("profile", metavar="NAME|FILE", help="a shipped profile, a TOML file, or the log of a run")
    parser.add_argument(
        "--engine", choices=("surrogate", "reference", "onnx"), help="default: the profile's (bench.engine)"
    )
    parser.add_argument("--json", action="store_true", help="findings as one JSON object")


def main(args: argparse.Namespace) -> int:
    """Build everything a run would build, without bus and clock; exit 2 with the reason where it cannot be built."""
    from hilrunner.base import status
    from hilrunner.commands.again import load_again
    from hilrunner.setup.arm import arm_offline
    from hilrunner.setup.axes import engine_named, period_ns, period_s, reference_plants
    from hilrunner.setup.contract import wiring
    from hilrunner.setup.host import bus_load_ratio
    from hilrunner.setup.period_cost import check_period_cost
    from hilrunner.setup.stability_store import stored_stability_limit_s
    from hilrunner.setup.stimulus import profile_stimulus
    from hilrunner.setup.traffic import profile_traffic
    from hilrunner.setup.wire_span import bench_warnings
    from hilrunner.setup.wire_text import whole_bus_load, wiring_dict, wiring_lines

    loaded = load_again(args.profile)
    stimulus = profile_stimulus(loaded).facts
    engine = engine_named(loaded, args.engine)
    armed = arm_offline(loaded, engine)
    if loaded.profile.crosscheck.enabled:
        reference_plants(loaded)
    cost_s = check_period_cost(armed)
    load = bus_load_ratio(profile_traffic(loaded, period_ns(loaded)), loaded.profile.can.bitrate)
    axes = []
    for axis, plant in zip(loaded.profile.axis, armed.axes.plants, strict=True):
        limit_s = stored_stability_limit_s(plant)
        count = plant.substep_count
        axes.append(
            {
                "name": axis.name,
                "substeps": count,
                "step_us": round(period_s(loaded) / count * 1e6, 2),
                "stability_limit_us": round(limit_s * 1e6, 2),
            }
        )
    understood, whole = wiring(loaded), whole_bus_load(loaded)
    found = {
        "profile": loaded.profile.name,
        "engine": status.ENGINE_NAMES[engine],
        "axes": axes,
        "period_cost_us": round(cost_s * 1e6, 1),
        "bus_load_ratio": round(load, 4),
        "dbc": armed.dbc_path.name,
        "stimulus": stimulus.as_dict(),
        "bus_load_ratio_all_messages": None if whole is None else round(whole, 4),
        "mapping": wiring_dict(understood),
        "warnings": _warnings(load) + list(stimulus.warnings) + bench_warnings(loaded, armed.axes),
    }
    if args.json:
        print(json.dumps(found))
        return 0
    print(f"{loaded.path}: profile {found['profile']} is sound, engine {found['engine']}")
    for axis in axes:
        print(
            f"  {axis['name']}: {axis['substeps']} substeps of {axis['step_us']} us; RK4 is stable up to "
            f"{axis['stability_limit_us']} us"
        )
    print(f"  one period costs {cost_s * 1e6:.1f} us of {period_s(loaded) * 1e6:g} us here, without bus and log")
    for report in armed.axes.model_reports:
        print("  " + report.text().replace("\n", "\n    "))
    print(
        f"  {found['dbc']}: bus load {100 * load:.1f} % of {loaded.profile.can.bitrate} bit/s by the mapped messages{_whole(whole)}"
    )
    for line in wiring_lines(loaded, understood):
        print(f"    {line}")
    print(f"  {stimulus.text()}")
    for warning in found["warnings"]:
        print(f"  warning: {warning}")
    return 0


def _whole(ratio: float | None) -> str:
    return "" if ratio is None else f", {100 * ratio:.1f} % by all messages of the file that have a cycle time"


def _warnings(bus_load_ratio: float) -> list[str]:
    """What a run would accept (a virtual bus has no bit rate) and a real bus would not."""
    if bus_load_ratio <= 1.0:
        return []
    return [
        f"a real bus cannot carry {100 * bus_load_ratio:.0f} %; remedy: raise can.bitrate or bench.period_us, or longer "
        "cycle times (GenMsgCycleTime in the DBC, cycle_ms in the mapping)"
    ]
